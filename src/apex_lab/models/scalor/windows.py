"""Boxes: from raw Gaussian latents to z_where = (s_x, s_y, t_x, t_y) (scalor.md sections 4 and 5).

s is the size as a share of the image side, t the centre in [-1, 1]; x to the right, y downwards.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from apex_lab.nn.grid import cells
from apex_lab.nn.spatial_transformer import window_of as window_of

Share = Annotated[float, Field(ge=0, lt=1)]
Positive = Annotated[float, Field(gt=0)]

SHIFT = 0.2
"""Largest change of a centre per frame."""

EDGE = 1.05
"""Centres of propagated objects stay within +-1.05."""


class SizeRule(ABC):
    """From two raw numbers to a box's size; the prior is N(0, 1) on the raw numbers under every rule."""

    @abstractmethod
    def __call__(self, raw: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """(r_0, r_1) -> (s_x, s_y)."""


@dataclass(frozen=True)
class AnchoredSize(SizeRule):
    """The published rule: S = size + size_range tanh r_0, R = ratio + ratio_range tanh r_1, (S / sqrt R, S sqrt R).

    The published constants allow upright boxes of the size of a pedestrian only: 5 to 12 px by 13 to 29 px of 128. Wide
    constants, such as 0.5, 0.48, 1.0, 0.5, lift the constraint and keep the formula.

    Args:
        size, size_range: mean size as a share of the image side, and how far it can go either way.
        ratio, ratio_range: the same of height / width.
    """

    size: Positive = 0.1
    size_range: Positive = 0.03
    ratio: Positive = 2.5
    ratio_range: Positive = 0.5

    def __post_init__(self) -> None:
        for name in ("size", "ratio"):
            middle, reach = getattr(self, name), getattr(self, f"{name}_range")
            if reach > middle or (name == "ratio" and reach == middle):
                raise ValueError(f"{name}_range={reach} must be below {name}={middle}: a box's {name} is positive")

    def __call__(self, raw: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        size = self.size + self.size_range * torch.tanh(raw[..., 0])
        root = (self.ratio + self.ratio_range * torch.tanh(raw[..., 1])).sqrt()
        return torch.stack([size / root, size * root], dim=-1)


@dataclass(frozen=True)
class FreeSize(SizeRule):
    """No size constraint: s = smallest + (1 - smallest) sigmoid(r + offset), width and height apart.

    Args:
        smallest: as a share of the image side. Pasting divides by the size, so gradients explode near 0.
        offset: moves the size at r = 0, where the prior is largest: 0 is about half of the image, -1.5 a fifth.
    """

    smallest: Share = 0.03
    offset: float = 0.0

    def __call__(self, raw: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        return self.smallest + (1 - self.smallest) * torch.sigmoid(raw + self.offset)


def discovered(raw: Float[Tensor, "B D 4"], size: SizeRule, grid: int) -> Float[Tensor, "B D 4"]:
    """z_where of all cells: a centre can move by a whole cell around its cell's."""
    centre = (2 / grid) * (cells(grid, raw) + 0.5 + torch.tanh(raw[..., 2:])) - 1
    return torch.cat([size(raw[..., :2]), centre], dim=-1)


def propagated(raw: Float[Tensor, "B P 4"], before: Float[Tensor, "B P 4"], size: SizeRule) -> Float[Tensor, "B P 4"]:
    """z_where of objects carried on: the centre moves from where it was, the size is inferred from scratch."""
    centre = (before[..., 2:] + SHIFT * torch.tanh(raw[..., 2:])).clamp(-EDGE, EDGE)
    return torch.cat([size(raw[..., :2]), centre], dim=-1)
