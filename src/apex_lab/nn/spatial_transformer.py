"""Spatial transformers for axis-aligned windows, as two matrix products (apex.md, section "Spatial transformers").

A window is (s_y, s_x, t_y, t_x): size as a share of the image side and centre in [-1, 1]. Bilinear sampling of an
axis-aligned window separates into one small matrix per axis with triangle weights, so a crop is `W_y F W_x^T` and a
paste `W_y^T A W_x`. The result equals `affine_grid` + `grid_sample(align_corners=False, padding_mode="zeros")`, is
deterministic on CUDA too, and needs no gather.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

PASTE_GUARD = 1e-9
"""Added to the sizes of windows that are pasted through: a paste divides by them, and they may be zero."""


def window_of(where: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """z_where as it is published, x first, (s_x, s_y, t_x, t_y) -> a window."""
    return where.unflatten(-1, (2, 2)).flip(-1).flatten(-2)


def for_paste(windows: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Windows whose sizes are guarded against zero, as published by SCALOR, SPACE and G-SWM."""
    size, centre = windows.split(2, dim=-1)
    return torch.cat([size + PASTE_GUARD, centre], dim=-1)


def pixel_centres(n: int, like: Tensor) -> Float[Tensor, " n"]:
    """Centres of `n` pixels on the axis [-1, 1]."""
    if like.device.type != "cpu" or torch.compiler.is_compiling():
        return (2 * torch.arange(n, device=like.device, dtype=like.dtype) + 1) / n - 1
    return _pixel_centres(n, like.dtype)


@functools.cache
def _pixel_centres(n: int, dtype: torch.dtype) -> Tensor:
    return (2 * torch.arange(n, dtype=dtype) + 1) / n - 1


@functools.cache
def _indices(n: int, dtype: torch.dtype) -> Tensor:
    return torch.arange(n, dtype=dtype)


class _Triangle(torch.autograd.Function):
    """Bilinear weights, with their gradient written by hand.

    Of the n weights of a position two are not zero, and they change by -1 and +1 with it: two numbers of each row of
    the gradient are all that is needed, where plain autograd passes over whole matrices four times.
    """

    @staticmethod
    def forward(ctx: Any, position: Tensor, n: int) -> Tensor:  # type: ignore[override]
        ctx.save_for_backward(position)
        if position.device.type == "cpu" and not torch.compiler.is_compiling():
            j = _indices(n, position.dtype)
        else:
            j = torch.arange(n, device=position.device, dtype=position.dtype)
        return (position[..., None] - j).abs_().neg_().add_(1).clamp_min_(0)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        (position,) = ctx.saved_tensors
        n = grad.shape[-1]
        below = position.floor().clamp(-2, n)  # far outside no weight is left to change
        pair = torch.stack([below, below + 1], dim=-1).long()
        there = (pair >= 0) & (pair < n)
        low, high = (grad.gather(-1, pair.clamp(0, n - 1)) * there).unbind(-1)
        return high - low, None


def _triangle(position: Float[Tensor, "... m"], n: int) -> Float[Tensor, "... m n"]:
    """Bilinear weights of source pixels 0..n-1 at the fractional pixel positions."""
    return _Triangle.apply(position, n)


def crop_weights(
    scale: Float[Tensor, "..."], centre: Float[Tensor, "..."], source: int, target: int
) -> Float[Tensor, "... target source"]:
    """One axis of a crop: row i holds the weights of the source pixels at target pixel i."""
    at = centre[..., None] + scale[..., None] * pixel_centres(target, scale)
    return _triangle((at + 1) * (source / 2) - 0.5, source)


def paste_weights(
    scale: Float[Tensor, "..."], centre: Float[Tensor, "..."], source: int, target: int
) -> Float[Tensor, "... source target"]:
    """One axis of a paste: column i holds the weights of the glimpse's pixels at image pixel i."""
    at = (pixel_centres(target, scale) - centre[..., None]) / scale[..., None]
    return _triangle((at + 1) * (source / 2) - 0.5, source).transpose(-1, -2)


def _by_axis(windows: Float[Tensor, "*batch 4"]) -> tuple[Float[Tensor, "2 ..."], Float[Tensor, "2 ..."]]:
    """Sizes and centres along y and x, so that one pass makes the weights of both axes."""
    size, centre = windows.movedim(-1, 0).contiguous().split(2)
    return size, centre


def crop(
    image: Float[Tensor, "B C H W"], windows: Float[Tensor, "B K 4"], size: int
) -> Float[Tensor, "B K C size size"]:
    """Cuts K windows out of each image; zero where a window reaches beyond the image."""
    if image.shape[-2] == image.shape[-1]:
        w_y, w_x = crop_weights(*_by_axis(windows), image.shape[-1], size).unbind()
    else:
        s_y, s_x, t_y, t_x = windows.unbind(-1)
        w_y = crop_weights(s_y, t_y, image.shape[-2], size)
        w_x = crop_weights(s_x, t_x, image.shape[-1], size)
    b, k = windows.shape[:2]
    # Channels ride along as columns, then as rows: two plain products per window, whose weights no channel repeats.
    rows = w_y.flatten(1, 2) @ image.transpose(1, 2).flatten(2)  # (B, K size, C W)
    crops = rows.reshape(b, k, -1, image.shape[-1]) @ w_x.transpose(-1, -2)  # (B, K, size C, size)
    return crops.unflatten(2, (size, -1)).transpose(2, 3)


def sampled_crop(
    image: Float[Tensor, "B C H W"], windows: Float[Tensor, "B K 4"], size: int
) -> Float[Tensor, "B K C size size"]:
    """`crop` by `grid_sample`: on a CPU faster for images without gradient, where it needs no scattered sum."""
    s_y, s_x, t_y, t_x = windows[..., None].unbind(-2)
    centres = pixel_centres(size, windows)
    y, x = t_y + s_y * centres, t_x + s_x * centres
    grid = torch.stack(torch.broadcast_tensors(x[:, :, None], y[..., None]), dim=-1)
    each = zip(image, grid, strict=True)
    return torch.stack([F.grid_sample(one.expand(len(at), -1, -1, -1), at, align_corners=False) for one, at in each])


class Paster:
    """Pastes glimpses of `glimpse` x `glimpse` pixels into images of `size` x `size`; zero outside the windows.

    Holds the two matrices of every window so that several pastes through the same windows share them.

    Args:
        windows: (..., 4) windows with any leading shape.
        glimpse: side of the glimpses in pixels.
        size: side of the image in pixels.
    """

    def __init__(self, windows: Float[Tensor, "... 4"], glimpse: int, size: int) -> None:
        self.w_y, self.w_x = paste_weights(*_by_axis(windows), glimpse, size).unbind()

    def each(self, glimpses: Float[Tensor, "... C g g"]) -> Float[Tensor, "... C size size"]:
        """Every glimpse in an image of its own.

        Channels ride along as extra columns, then as extra rows, so each window takes two plain matrix products.
        Between them, while they are small, they are brought in order: images are contiguous.
        """
        channels = glimpses.shape[-3]
        rows = self.w_y.transpose(-1, -2) @ glimpses.transpose(-3, -2).flatten(-2)
        rows = rows.unflatten(-1, (channels, -1)).transpose(-3, -2)
        return (rows.flatten(-3, -2) @ self.w_x).unflatten(-2, (channels, -1))

    def total(self, glimpses: Float[Tensor, "... K g g"]) -> Float[Tensor, "... size size"]:
        """All K glimpses summed in one image, without making the K images (`self` has windows (..., K, 4))."""
        rows = glimpses @ self.w_x
        return self.w_y.flatten(-3, -2).transpose(-1, -2) @ rows.flatten(-3, -2)

    def inside(self) -> tuple[Float[Tensor, "... size"], Float[Tensor, "... size"]]:
        """How far each image row and column lies inside the window, in [0, 1]: a pasted glimpse of ones, factorised."""
        return self.w_y.sum(-2), self.w_x.sum(-2)


def paste(
    glimpses: Float[Tensor, "... C g g"], windows: Float[Tensor, "... 4"], size: int
) -> Float[Tensor, "... C size size"]:
    """Pastes each glimpse into an empty image through its window (the inverse of `crop`)."""
    return Paster(windows, glimpses.shape[-1], size).each(glimpses)
