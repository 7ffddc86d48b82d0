"""Spatial transformers by `affine_grid` and `grid_sample`, as published implementations have them.

The same results as `apex_lab.nn.spatial_transformer`, by a sampling grid of the size of every output picture.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from apex_lab.nn.spatial_transformer import Paster, pixel_centres


def _grid(scale: Float[Tensor, "N 2"], centre: Float[Tensor, "N 2"], size: int) -> Float[Tensor, "N size size 2"]:
    """Where the pixels of `size` x `size` outputs lie in the source: centre + scale * output; both given as (y, x)."""
    nothing = torch.zeros_like(scale[:, 0])
    rows = [
        torch.stack([scale[:, 1], nothing, centre[:, 1]], dim=-1),
        torch.stack([nothing, scale[:, 0], centre[:, 0]], dim=-1),
    ]
    return F.affine_grid(torch.stack(rows, dim=1), [len(scale), 1, size, size], align_corners=False)


def grid_crop(
    image: Float[Tensor, "B C H W"], windows: Float[Tensor, "B K 4"], size: int
) -> Float[Tensor, "B K C size size"]:
    """`spatial_transformer.crop`: every window gets its copy of the image to sample from."""
    b, k = windows.shape[:2]
    scale, centre = windows.flatten(0, 1).split(2, dim=-1)
    copies = image[:, None].expand(-1, k, -1, -1, -1).flatten(0, 1)
    crops = F.grid_sample(copies, _grid(scale, centre, size), padding_mode="zeros", align_corners=False)
    return crops.unflatten(0, (b, k))


class GridPaster(Paster):
    """`spatial_transformer.Paster`: every glimpse becomes a picture of its own, sums are taken over pictures."""

    def __init__(self, windows: Float[Tensor, "... 4"], glimpse: int, size: int) -> None:
        self._leading = windows.shape[:-1]
        self._glimpse, self._size = glimpse, size
        scale, centre = windows.reshape(-1, 4).split(2, dim=-1)
        self._scale, self._centre = 1 / scale, -centre / scale
        self._at = _grid(self._scale, self._centre, size)

    def each(self, glimpses: Float[Tensor, "... C g g"]) -> Float[Tensor, "... C size size"]:
        """Every glimpse in an image of its own."""
        flat = glimpses.reshape(-1, *glimpses.shape[-3:])
        images = F.grid_sample(flat, self._at, padding_mode="zeros", align_corners=False)
        return images.unflatten(0, self._leading)

    def total(self, glimpses: Float[Tensor, "... K g g"]) -> Float[Tensor, "... size size"]:
        """All K glimpses summed in one image."""
        return self.each(glimpses[..., None, :, :]).squeeze(-3).sum(-3)

    def inside(self) -> tuple[Float[Tensor, "... size"], Float[Tensor, "... size"]]:
        """How far each image row and column lies inside the window, in [0, 1]."""
        axis = pixel_centres(self._size, self._scale)
        at = self._centre[:, None] + self._scale[:, None] * axis[:, None]  # (N, size, 2)
        lines = []
        for i in range(2):  # a line of ones along y, then along x, sampled in the middle of its single column
            line = torch.stack([torch.zeros_like(at[..., i]), at[..., i]], dim=-1)[:, :, None]
            ones = at.new_ones(len(at), 1, self._glimpse, 1)
            sampled = F.grid_sample(ones, line, padding_mode="zeros", align_corners=False)
            lines.append(sampled[:, 0, :, 0].unflatten(0, self._leading))
        return lines[0], lines[1]
