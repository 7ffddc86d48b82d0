"""Boxes: cell centres, discovered and proposed boxes, overlap, rejection (gswm.md sections 4 to 6).

z_where = (s_x, s_y, t_x, t_y): size as a share of the image side, centre in [-1, 1]. Sizes are not bounded after
discovery: propagation adds to them, so one may leave (0, 1), unless `Motion.bounded`.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from apex_lab.nn.grid import cell_centres as cell_centres
from apex_lab.nn.spatial_transformer import for_paste, window_of

OVERLAP_GUARD = 1e-5


def discovered_box(raw: Float[Tensor, "... D 4"], centres: Float[Tensor, "D 2"]) -> Float[Tensor, "... D 4"]:
    """Raw latent of each cell -> z_where. The centre moves by at most a whole cell, so it may leave the image."""
    size, shift = raw.split(2, dim=-1)
    grid = math.isqrt(len(centres))
    return torch.cat([torch.sigmoid(size), 2 / grid * torch.tanh(shift) + centres], dim=-1)


def enlarged(where: Float[Tensor, "... 4"], by: Float[Tensor, "... 2"] | float) -> Float[Tensor, "... 4"]:
    """A box with the same centre whose size is larger by `by`."""
    size, shift = where.split(2, dim=-1)
    return torch.cat([size + by, shift], dim=-1)


def paste_window(where: Float[Tensor, "... 4"]) -> Float[Tensor, "... 4"]:
    """z_where -> window of a paste, which divides by the size: guarded as published."""
    return for_paste(window_of(where))


def gaussian_weight(offset: Float[Tensor, "... 2"], sigma: float) -> Float[Tensor, "..."]:
    """Density of an isotropic Gaussian of that standard deviation at an offset (x, y)."""
    return (-offset.square().sum(-1) / (2 * sigma**2)).exp() / (2 * math.pi * sigma**2)


def overlap(a: Float[Tensor, "B N 4"], b: Float[Tensor, "B M 4"]) -> Float[Tensor, "B N M"]:
    """Intersection over union of every box of `a` with every box of `b`; zero where an area is zero."""

    def corners(where: Tensor) -> tuple[Tensor, Tensor]:
        size, shift = where.split(2, dim=-1)
        centre = (shift + 1) / 2
        return centre - size / 2, centre + size / 2

    (low_a, high_a), (low_b, high_b) = corners(a[:, :, None]), corners(b[:, None])
    sides = (torch.minimum(high_a, high_b) - torch.maximum(low_a, low_b)).clamp_min(0)
    both = sides.prod(-1)
    area_a, area_b = a[:, :, None, :2].prod(-1), b[:, None, :, :2].prod(-1)
    whole = area_a + area_b - both
    return torch.where((area_a == 0) | (area_b == 0), 0.0, both / (whole + OVERLAP_GUARD))


def rejected(
    found: Float[Tensor, "B D 4"], tracked: Float[Tensor, "B M 4"], presence: Float[Tensor, "B M"], threshold: float
) -> Float[Tensor, "B D"]:
    """1 where a discovered box overlaps a present (z_pres > 0.5) tracked one by more than the threshold, else 0."""
    with torch.no_grad():
        hit = (overlap(found, tracked) > threshold) & (presence > 0.5)[:, None]
        return hit.any(-1).to(found.dtype)
