"""z_where: from Gaussian latents to windows, for discovery and for propagation.

A *place* is carried from frame to frame: (logit of s_y, logit of s_x, t_y, t_x). A *window* is what spatial
transformers take: (s_y, s_x, t_y, t_x).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.nn.grid import cell_centres

MAX_LOGIT = 4.0
"""Bound of the size logit: windows between 1.8 % and 98.2 % of the image side, so gradients through 1/s stay finite."""


def soft_bound(x: Tensor, bound: float) -> Tensor:
    """Identity near zero, saturating at +-bound."""
    return bound * torch.tanh(x / bound)


def window_of(place: Float[Tensor, "... 4"]) -> Float[Tensor, "... 4"]:
    """Place -> window."""
    size, centre = place.split(2, dim=-1)
    return torch.cat([torch.sigmoid(size), centre], dim=-1)


def square_of(window: Float[Tensor, "... 4"]) -> Float[Tensor, "... 4"]:
    """The square window around the same centre whose side is the larger side (propagation crop)."""
    side = window[..., :2].amax(-1, keepdim=True)
    return torch.cat([side, side, window[..., 2:]], dim=-1)


def keep_in_image(centre: Tensor) -> Tensor:
    """Clamps centres to [-1, 1] but lets the gradient through, so an object at the border can come back."""
    return centre + (centre.clamp(-1, 1) - centre).detach()


class Windows(nn.Module):
    """Squashes z_where (apex.md, "Shapes and symbols").

    Args:
        grid: G, discovery cells per side.
        reach: how far a discovered window's centre may lie from its cell's centre, in cells.
        size_step: largest change of a size logit from one frame to the next.
        centre_step: largest change of a centre from one frame to the next, in [-1, 1] coordinates.
    """

    cells: Tensor

    def __init__(self, grid: int, reach: float, size_step: float, centre_step: float) -> None:
        super().__init__()
        self.register_buffer("cells", cell_centres(grid).flip(-1), persistent=False)  # (y, x)
        self.reach = reach * 2 / grid
        self.size_step, self.centre_step = size_step, centre_step

    def discovered(self, z: Float[Tensor, "... D 4"]) -> Float[Tensor, "... D 4"]:
        """Latent of each cell -> place."""
        size, centre = z.split(2, dim=-1)
        centre = keep_in_image(self.cells + self.reach * torch.tanh(centre))
        return torch.cat([soft_bound(size, MAX_LOGIT), centre], dim=-1)

    def propagated(self, place: Float[Tensor, "... 4"], z: Float[Tensor, "... 4"]) -> Float[Tensor, "... 4"]:
        """The place at t - 1 and the latent change -> place at t. A change of zero leaves the place as it is."""
        size, centre = place.split(2, dim=-1)
        step = torch.tanh(z)
        size = (size + self.size_step * step[..., :2]).clamp(-MAX_LOGIT, MAX_LOGIT)
        centre = keep_in_image(centre + self.centre_step * step[..., 2:])
        return torch.cat([size, centre], dim=-1)


def size_logit(share: float) -> float:
    """Logit of a window size given as a share of the image side."""
    return math.log(share / (1 - share))
