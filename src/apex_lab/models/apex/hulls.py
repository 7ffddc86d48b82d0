"""Convex hulls of masks, without a loop over pixels: one shape of work whatever the masks hold."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

DIRECTIONS = 32
"""Sides of the polygon that stands for a hull; a multiple of 4, so that upright boxes are their own hulls."""

TOLERANCE = 1e-3
"""Pixels by which a pixel's centre may lie outside, for rounding."""


def hollow(mask: Bool[Tensor, "V H W"], counted: Bool[Tensor, "V H W"]) -> Float[Tensor, " V"]:
    """How many counted pixels lie in the convex hull of a mask's pixel centres; none where the mask is empty.

    The hull is the polygon of its tangents in `DIRECTIONS` directions: never smaller than the hull, larger by less
    than a pixel at the sizes of objects.
    """
    h, w = mask.shape[-2:]
    rows, columns = (torch.arange(n, device=mask.device, dtype=torch.float32) for n in (h, w))
    angle = torch.arange(DIRECTIONS, device=mask.device, dtype=torch.float64) * (2 * math.pi / DIRECTIONS)
    # In exact quarters: a sine of 1e-17 would turn a tangent along the rows into a division by it
    along_x, along_y = (x.round(decimals=12).float() for x in (angle.cos(), angle.sin()))
    # The farthest pixel of a row is its first or its last, so tangents need two numbers per row
    filled = mask.any(2)
    left = torch.where(mask, columns, w).amin(2)
    right = torch.where(mask, columns, -1.0).amax(2)
    ends = torch.maximum(left[..., None] * along_x, right[..., None] * along_x)  # (V, H, D)
    far = (ends + rows[:, None] * along_y).masked_fill(~filled[..., None], -torch.inf).amax(1)  # (V, D)
    # x cos + y sin <= far, for all directions: in each row an interval of x
    room = far[:, None] - rows[:, None] * along_y + TOLERANCE  # (V, H, D)
    upright = along_x == 0
    bound = room / torch.where(upright, 1.0, along_x)
    most = bound.masked_fill(along_x <= 0, torch.inf).amin(2)
    least = bound.masked_fill(along_x >= 0, -torch.inf).amax(2)
    open_ = (room >= 0).masked_fill(~upright, True).all(2)
    inside = (columns >= least[..., None]) & (columns <= most[..., None]) & open_[..., None]
    return (inside & counted).sum((1, 2)).to(torch.float32)
