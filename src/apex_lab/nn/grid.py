"""The cells of a grid over the image, row by row: cell n lies in column n mod G of row n // G."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from apex_lab.nn.spatial_transformer import pixel_centres


def cells(grid: int, like: Tensor) -> Float[Tensor, "D 2"]:
    """(column, row) of the G^2 cells, from 0 on, in the type and on the device of `like`."""
    return _pairs(torch.arange(grid, device=like.device, dtype=like.dtype))


def cell_centres(grid: int) -> Float[Tensor, "D 2"]:
    """Centres (x, y) of the G^2 cells in [-1, 1]."""
    return _pairs(pixel_centres(grid, torch.zeros(())))


def _pairs(axis: Float[Tensor, " G"]) -> Float[Tensor, "D 2"]:
    row, column = torch.meshgrid(axis, axis, indexing="ij")
    return torch.stack([column, row], dim=-1).reshape(-1, 2)
