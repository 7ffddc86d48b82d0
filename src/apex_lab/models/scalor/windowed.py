"""Composition on a CPU, component by component, each inside its window only.

Outside of its window a component is exactly zero. With windows of half the image's side, a quarter of the image is left
to sample and to sum. One component's maps stay in the cache, and none is kept for the backward pass.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from apex_lab.nn.spatial_transformer import pixel_centres

BILINEAR_WITH_ZEROS = (0, 0, False)
"""Of PyTorch's grid sampler: interpolation, padding, corners not aligned."""


class Places(NamedTuple):
    """Where the image's rows and columns lie in the glimpses of K components of N frames, which reach from -1 to 1."""

    y: Float[Tensor, "N K H"]
    x: Float[Tensor, "N K W"]


class Window(NamedTuple):
    """Rows and columns of the image that a component reaches, and where they lie in its glimpse, (1, h, w, 2)."""

    rows: slice
    columns: slice
    grid: Tensor

    def pasted(self, glimpse: Float[Tensor, "C g g"]) -> Float[Tensor, "C h w"]:
        """The glimpse in this part of the image."""
        return torch.grid_sampler_2d(glimpse[None], self.grid, *BILINEAR_WITH_ZEROS)[0]

    def through(
        self, gradient: Float[Tensor, "C h w"], glimpse: Float[Tensor, "C g g"]
    ) -> tuple[Float[Tensor, "C g g"], Float[Tensor, " h"], Float[Tensor, " w"]]:
        """Gradients with respect to the glimpse and to the places of rows and columns."""
        to_glimpse, to_grid = torch.ops.aten.grid_sampler_2d_backward(
            gradient[None], glimpse[None], self.grid, *BILINEAR_WITH_ZEROS, [True, True]
        )
        return to_glimpse[0], to_grid[0, :, :, 1].sum(1), to_grid[0, :, :, 0].sum(0)


def places_of(windows: Float[Tensor, "N K 4"], size: int) -> Places:
    """For an image of `size` px; windows (s_y, s_x, t_y, t_x) without a size of zero."""
    centres = pixel_centres(size, windows)
    s_y, s_x, t_y, t_x = windows[..., None].unbind(-2)
    return Places((centres - t_y) / s_y, (centres - t_x) / s_x)


def reached(places: Places, glimpse: int) -> tuple[Bool[Tensor, "N K H"], Bool[Tensor, "N K W"]]:
    """Rows and columns that see the glimpse: bilinear weights end a pixel beyond its outermost pixels' centres."""
    edge = 1 + 1 / glimpse
    return (places.y.abs() < edge), (places.x.abs() < edge)


def _windows(places: Places, glimpse: int) -> Iterator[Window | None]:
    """Of one component after the other; None where no pixel is reached."""
    y, x = (at.detach().flatten(0, 1) for at in places)
    spans = zip(*(_ranges(inside.flatten(0, 1)) for inside in reached(places, glimpse)), strict=True)
    for (rows, columns), down, across in zip(spans, y.unbind(), x.unbind(), strict=True):
        height, width = rows.stop - rows.start, columns.stop - columns.start
        if height and width:
            grid = across.new_empty(1, height, width, 2)
            grid[..., 0] = across[columns]
            grid[..., 1] = down[rows, None]
            yield Window(rows, columns, grid)
        else:
            yield None


def _ranges(inside: Bool[Tensor, "M n"]) -> list[slice]:
    first, count = inside.int().argmax(1).tolist(), inside.sum(1).tolist()
    return [slice(a, a + n) for a, n in zip(first, count, strict=True)]


def overlaps(
    glimpses: Float[Tensor, "N K g g"], places: Places, above: float, among: Float[Tensor, "N H W"]
) -> tuple[Float[Tensor, "N K"], Float[Tensor, "N K"]]:
    """How many pixels of each pasted glimpse are above a value, and how many of them lie where `among` is 1, else 0."""
    found = among.new_zeros(2, *glimpses.shape[:2])
    each = zip(glimpses.flatten(0, 1), _windows(places, glimpses.shape[-1]), found.flatten(1).unbind(1), strict=True)
    for i, (glimpse, at, (mine, shared)) in enumerate(each):
        if at is not None:
            pixels = (at.pasted(glimpse[None])[0] > above).to(among.dtype)
            torch.sum(pixels, (0, 1), out=mine)
            torch.sum(pixels * among[i // glimpses.shape[1], at.rows, at.columns], (0, 1), out=shared)
    return found[0], found[1]


def squares(
    glimpses: Float[Tensor, "N K g g"], factors: Float[Tensor, "N K"], places: Places
) -> Float[Tensor, "N K H W"]:
    """Squares of the pasted glimpses, times a factor each."""
    found = glimpses.new_zeros(*glimpses.shape[:2], places.y.shape[-1], places.x.shape[-1])
    each = zip(
        glimpses.flatten(0, 1),
        factors.flatten().tolist(),
        _windows(places, glimpses.shape[-1]),
        found.flatten(0, 1),
        strict=True,
    )
    for glimpse, factor, at, image in each:
        if at is not None and factor != 0:
            image[at.rows, at.columns] = at.pasted(glimpse[None])[0].square_().mul_(factor)
    return found


class _Component:
    """One component inside its window.

    shown (4, g, g): o alpha z_pres, alpha z_pres. maps (4, h, w): the same, pasted. mask (h, w): the last of them.
    """

    def __init__(self, drawn: Tensor, presence: Tensor, at: Window) -> None:
        self.shown = torch.empty_like(drawn, memory_format=torch.contiguous_format)
        self.alpha = torch.mul(drawn[3], presence, out=self.shown[3])
        torch.mul(drawn[:3], self.alpha, out=self.shown[:3])
        self.maps = at.pasted(self.shown)
        self.mask = self.maps[3]


class _Composed(torch.autograd.Function):
    """See `composed`."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, drawn: Tensor, presence: Tensor, near: Tensor, counted: Tensor, y: Tensor, x: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        ctx.save_for_backward(drawn, presence, near, counted, y, x)
        n, area = len(drawn), (y.shape[-1], x.shape[-1])
        alpha, weight, products = drawn.new_zeros(n, *area), drawn.new_zeros(n, *area), drawn.new_zeros(n, 4, *area)
        for (t, k), at, counts, share in _present(presence, near, counted, Places(y, x), drawn.shape[-1]):
            one = _Component(drawn[t, k], presence[t, k], at)
            nearer = one.mask * share
            alpha[t, at.rows, at.columns].add_(one.mask, alpha=counts)
            weight[t, at.rows, at.columns].add_(nearer)
            products[t, :, at.rows, at.columns].addcmul_(one.maps, nearer)
        shares = products[:, 3]
        ctx.mark_non_differentiable(shares)
        return alpha, weight, products[:, :3], shares

    @staticmethod
    @once_differentiable
    def backward(  # type: ignore[override]
        ctx: Any, on_alpha: Tensor, on_weight: Tensor, on_colour: Tensor, _: Tensor
    ) -> tuple[Tensor | None, ...]:
        drawn, presence, near, counted, y, x = ctx.saved_tensors
        to_drawn = torch.zeros_like(drawn, memory_format=torch.contiguous_format)
        to_presence, to_near, to_y, to_x = (torch.zeros_like(values) for values in (presence, near, y, x))
        for (t, k), at, counts, share in _present(presence, near, counted, Places(y, x), drawn.shape[-1]):
            glimpse = drawn[t, k]
            one = _Component(glimpse, presence[t, k], at)
            on_colours = on_colour[t, :, at.rows, at.columns]
            # the mask counts in alpha, and with its nearness in the weight and as the factor of the colours
            on_nearer = torch.linalg.vecdot(on_colours, one.maps[:3], dim=0).add_(on_weight[t, at.rows, at.columns])
            torch.dot(on_nearer.flatten(), one.mask.flatten(), out=to_near[t, k])
            on_maps = torch.empty_like(one.maps)
            torch.mul(on_colours, one.mask * share, out=on_maps[:3])
            torch.add(on_alpha[t, at.rows, at.columns] * counts, on_nearer, alpha=share, out=on_maps[3])

            on_shown, to_y[t, k, at.rows], to_x[t, k, at.columns] = at.through(on_maps, one.shown)
            on_mask = torch.linalg.vecdot(on_shown[:3], glimpse[:3], dim=0).add_(on_shown[3])
            torch.dot(on_mask.flatten(), glimpse[3].flatten(), out=to_presence[t, k])
            torch.mul(on_shown[:3], one.alpha, out=to_drawn[t, k, :3])
            torch.mul(on_mask, presence[t, k], out=to_drawn[t, k, 3])
        return to_drawn, to_presence, to_near, None, to_y, to_x


def _present(
    presence: Tensor, near: Tensor, counted: Tensor, places: Places, glimpse: int
) -> Iterator[tuple[tuple[int, int], Window, float, float]]:
    """Frame and index, window, `counted` and `near` of the components that show."""
    index = itertools.product(*(range(n) for n in presence.shape))
    numbers = (values.flatten().tolist() for values in (presence, counted, near))
    for which, at, there, counts, share in zip(index, _windows(places, glimpse), *numbers, strict=True):
        if at is not None and there != 0:
            yield which, at, counts, share


def composed(
    drawn: Float[Tensor, "N K 4 g g"],
    presence: Float[Tensor, "N K"],
    near: Float[Tensor, "N K"],
    counted: Float[Tensor, "N K"],
    places: Places,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The fields of `composition.Layers`. A component whose presence is zero takes no part and gets no gradient."""
    return _Composed.apply(drawn, presence, near, counted, *places)
