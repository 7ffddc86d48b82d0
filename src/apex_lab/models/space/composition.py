"""From glimpses to the foreground of an image, and the boundary loss (space.md sections 4 and 7)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from apex_lab.nn.precision import full
from apex_lab.nn.spatial_transformer import Paster
from apex_lab.nn.splitting import part_size

IMPORTANCE = 100.0
KERNEL, FRAME = 32, 6
"""Side of the boundary kernel and width of its frame, in kernel pixels."""
STEEPNESS, TOLERANCE = 1000.0, 0.7
"""Factor on the pasted kernel and standard deviation of the boundary loss."""

IMAGES = 16
"""Images composed at once: bounds the memory of the full-size maps, of which there are four a cell."""

ROWS = 16
"""Of an image, composed at once where a part is not a whole image: the fewer, the fewer cells reach them."""

LOWEST = -80.0
"""Logits this far below the largest are raised to it: their share is nothing, and numbers that underflow are slow."""


class Composition(NamedTuple):
    """The foreground of n images.

    shares (n, N, H, W): w A of each cell, without gradient; alpha (n, H, W): their sum, in [0, 1];
    mean (n, 3, H, W): mu_fg, colours already multiplied by the masks.
    """

    shares: Tensor
    alpha: Tensor
    mean: Tensor


class _Compose(torch.autograd.Function):
    """Paste, softmax over cells and weighted sum, with the gradient written by hand.

    Plain autograd keeps about ten maps of H x W for every cell. This keeps none: the backward pass pastes again, and
    both work on strips of an image that stay in the processor's cache.
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, glimpses: Tensor, strength: Tensor, w_y: Tensor, w_x: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Glimpses (n, N, 4, g, g), strength (n, N), weights (n, N, g, H) and (n, N, g, W).

        Returns sums over cells (n, 4, H, W) of mask and masked colours, and shares (n, N, H, W).
        """
        n, count, channels = glimpses.shape[:3]
        h, w = w_y.shape[-1], w_x.shape[-1]
        total = glimpses.new_zeros(n, channels, h, w)
        shares = glimpses.new_zeros(n, count, h, w)
        for images, rows, cells in _strips(w_y, channels * w):
            maps = _pasted(_rows(glimpses[images, cells], w_y[images, cells, :, rows]), w_x[images, cells])
            weights = _weights(maps[:, :, 0], strength[images, cells], count)
            maps.mul_(weights[:, :, None])
            shares[images, cells, rows] = maps[:, :, 0]
            total[images, :, rows] = maps.sum(1)
        ctx.save_for_backward(glimpses, strength, w_y, w_x, total)
        ctx.mark_non_differentiable(shares)
        return total, shares

    @staticmethod
    def backward(ctx: Any, grad: Tensor, _: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # type: ignore[override]
        glimpses, strength, w_y, w_x, total = ctx.saved_tensors
        count, channels = glimpses.shape[1:3]
        to_glimpses, to_strength, to_w_y, to_w_x = (torch.zeros_like(x) for x in (glimpses, strength, w_y, w_x))
        # the softmax's gradient needs sum_n w_n dL/dw_n, and that is the sum over what the weights gave
        mean_gain = (grad * total).sum(1, keepdim=True)
        for images, rows, cells in _strips(w_y, channels * w_x.shape[-1]):
            some, some_y, some_x = glimpses[images, cells], w_y[images, cells, :, rows], w_x[images, cells]
            bent = _rows(some, some_y)  # (b, N, 4 r, g)
            maps = _pasted(bent, some_x)
            factor = strength[images, cells]
            weights = _weights(maps[:, :, 0], factor, count)
            strip = grad[images, None, :, rows]
            to_logit = (maps * strip).sum(2).sub_(mean_gain[images, :, rows]).mul_(weights)
            to_strength[images, cells] += (to_logit * maps[:, :, 0]).sum((-2, -1))
            to_maps = torch.mul(strip, weights[:, :, None], out=maps)
            to_maps[:, :, 0].addcmul_(to_logit, factor[..., None, None])
            flat = to_maps.flatten(2, 3)  # (b, N, 4 r, W)
            to_w_x[images, cells] += bent.transpose(-1, -2) @ flat
            to_bent = (flat @ some_x.transpose(-1, -2)).unflatten(2, (channels, -1))  # (b, N, 4, r, g)
            to_bent = to_bent.transpose(2, 3).flatten(3)  # (b, N, r, 4 g)
            to_glimpses[images, cells] += (some_y @ to_bent).unflatten(-1, (channels, -1)).transpose(2, 3)
            to_w_y[images, cells, :, rows] = _side_by_side(some) @ to_bent.transpose(-1, -2)
        return to_glimpses, to_strength, to_w_y, to_w_x


def _strips(
    w_y: Float[Tensor, "n N g H"], values_each: int
) -> Iterator[tuple[slice, slice, slice | Int[Tensor, " active"]]]:
    """Parts (images, rows, cells) of n images whose rows have `values_each` numbers in the maps of a cell.

    On a CPU a part is a few rows of an image, and has only those cells whose windows reach them: the others draw
    nothing there, and no gradient comes back to them.
    """
    n, count, _, height = w_y.shape
    images = min(IMAGES, part_size(n, count * height * values_each, w_y))
    rows = part_size(height, count * values_each, w_y)
    if n > images == 1 or rows < height:
        rows = min(rows, ROWS)
    reached = w_y.sum(2) > 0 if rows < height else None
    for i in range(0, n, images):
        for y in range(0, height, rows):
            strip = slice(y, min(y + rows, height))
            if reached is None:
                yield slice(i, min(i + images, n)), strip, slice(None)
                continue
            active = reached[i, :, strip].any(1).nonzero().squeeze(1)
            if len(active):
                yield slice(i, i + 1), strip, active


def _side_by_side(glimpses: Tensor) -> Tensor:
    """(..., C, g, g) -> (..., g, C g)."""
    return glimpses.transpose(-3, -2).flatten(-2)


def _rows(glimpses: Tensor, w_y: Tensor) -> Tensor:
    """Glimpses (..., C, g, g) stretched to image rows: (..., C r, g)."""
    rows = w_y.transpose(-1, -2) @ _side_by_side(glimpses)
    return rows.unflatten(-1, (glimpses.shape[-3], -1)).transpose(-3, -2).flatten(-3, -2)


def _pasted(rows: Tensor, w_x: Tensor, channels: int = 4) -> Tensor:
    """Stretched rows (..., C r, g) -> maps (..., C, r, W)."""
    return (rows @ w_x).unflatten(-2, (channels, -1))


def _weights(masks: Tensor, strength: Tensor, count: int) -> Tensor:
    """Softmax over `count` cells of strength times mask, for those along dim 1.

    A cell that does not cover a pixel has the logit 0, also one that is left out.
    """
    logit = masks * strength[..., None, None]
    largest = logit.amax(1, keepdim=True)  # at least 0
    weights = logit.sub_(largest).clamp_min_(LOWEST).exp_()
    total = weights.sum(1, keepdim=True)
    if len(strength[0]) < count:
        total.add_(largest.neg_().clamp_min_(LOWEST).exp_(), alpha=count - len(strength[0]))
    return weights.div_(total)


def compose(
    mask: Float[Tensor, "n N 1 g g"],
    colour: Float[Tensor, "n N 3 g g"],
    depth: Float[Tensor, "n N"],
    paster: Paster,
) -> Composition:
    """Weighs the cells at every pixel and sums them (section 4).

    The importance logit, paste(100 ahat sigmoid(-depth)), is 100 sigmoid(-depth) A, since a paste is linear.

    Args:
        mask: ahat, the decoded mask times z_pres, in [0, 1].
        colour: RGB in [0, 1].
        depth: z_depth; the smaller, the nearer and the heavier.
        paster: of the cells' windows.
    """
    with torch.autocast(mask.device.type, enabled=False):
        mask, colour = full(mask), full(colour)
        glimpses = torch.cat([mask, mask * colour], dim=2)
        strength = IMPORTANCE * torch.sigmoid(-depth)
        total, shares = _Compose.apply(glimpses, strength, paster.w_y, paster.w_x)
        return Composition(shares, total[:, 0], total[:, 1:])


def boundary_kernel() -> Float[Tensor, "32 32"]:
    """1/1024 on a frame of 6 pixels, 0 within."""
    kernel = torch.full((KERNEL, KERNEL), 1 / KERNEL**2)
    kernel[FRAME:-FRAME, FRAME:-FRAME] = 0
    return kernel


def boundary_loss(
    kernel: Float[Tensor, "32 32"],
    presence: Float[Tensor, "n N"],
    alpha: Float[Tensor, "n H W"],
    paster: Paster,
) -> Float[Tensor, " n"]:
    """Penalty on foreground near the rims of windows, so that windows are large enough; nats, with its constant.

    Args:
        kernel: `boundary_kernel`.
        presence: z_pres.
        alpha: foreground, in [0, 1].
        paster: of the cells' windows, for glimpses of the kernel's size.
    """
    with torch.autocast(alpha.device.type, enabled=False):
        rims = STEEPNESS * paster.total(kernel * presence[..., None, None])
        constant = math.log(TOLERANCE) + 0.5 * math.log(2 * math.pi)
        return (0.5 * (rims * alpha / TOLERANCE).square() + constant).flatten(1).sum(1)
