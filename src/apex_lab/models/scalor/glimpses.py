"""Glimpse networks, shared by discovery and propagation (scalor.md section 7)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.models.scalor.blocks import enlarged, halved, laid_out, same
from apex_lab.models.scalor.latents import full_precision
from apex_lab.nn.parts import joined, part_size
from apex_lab.nn.spatial_transformer import crop

CODE = 128
"""Length of the glimpse encoder's output."""


def _doublings(size: int) -> int:
    """How often 4 pixels are doubled to make a glimpse.

    Raises:
        ValueError: the size is none of 16, 32, 64.
    """
    if size not in (16, 32, 64):
        raise ValueError(f"glimpse_size={size} must be 16, 32 or 64")
    return round(math.log2(size / 4))


class GlimpseEncoder(nn.Module):
    """Glimpse of the image -> mean and raw standard deviation of z_what.

    Published for glimpses of 32 and 64 px; 16 px follows the rule of 32 px.

    Args:
        size: g, side of a glimpse in pixels.
        what: length of z_what.
    """

    def __init__(self, size: int, what: int) -> None:
        super().__init__()
        self.size = size
        layers: list[nn.Module] = []
        channels = 3
        for width in (16, 32, 64, 128)[: _doublings(size)]:
            layers += halved(channels, width)
            channels = width
        if size < 64:
            layers += same(channels, channels)
        layers += [nn.Conv2d(channels, CODE, 4), nn.CELU(inplace=True), nn.GroupNorm(16, CODE)]
        self.stack = nn.Sequential(*layers)
        self.head = nn.Linear(CODE, 2 * what)

    def encode(self, glimpses: Float[Tensor, "N 3 g g"]) -> Float[Tensor, "N two_Z"]:
        """Means, then raw standard deviations."""
        return self.head(self.stack(laid_out(glimpses)).flatten(1))

    def _cut(self, images: Tensor, windows: Tensor) -> Float[Tensor, "BK 3 g g"]:
        with full_precision(images):
            return crop(images, windows, self.size).flatten(0, 1)

    def forward(
        self, images: Float[Tensor, "B 3 H W"], windows: Float[Tensor, "B K 4"]
    ) -> Float[Tensor, "B K two_Z"]:
        """Cuts windows (s_y, s_x, t_y, t_x) out of images and encodes them."""
        count = windows.shape[1]
        size = part_size(len(images), count * 16 * (self.size // 2) ** 2, images)
        return joined(
            self.encode(self._cut(some, places)).unflatten(0, (-1, count))
            for some, places in zip(images.split(size), windows.split(size), strict=True)
        )


class GlimpseDecoder(nn.Module):
    """z_what -> an object's colour o and mask alpha, each in [0, 1].

    Published for glimpses of 32 and 64 px; 16 px follows the rule of 32 px. The two heads have a hidden layer at images
    of 128 px and none below.

    Args:
        size: g, side of a glimpse in pixels.
        what: length of z_what.
        deep_heads: with a hidden layer.
    """

    def __init__(self, size: int, what: int, deep_heads: bool) -> None:
        super().__init__()
        self.size, self.deep_heads = size, deep_heads
        layers = [*same(what, 128, kernel=1), *enlarged(128, 64, 4)]
        if _doublings(size) == 4:
            layers += [*same(64, 64), *enlarged(64, 64, 4), *same(64, 64), *enlarged(64, 32, 2)]
            layers += [*same(32, 32), *enlarged(32, 16, 2)]
        else:
            widths = (64, 64, 32, 16)[4 - _doublings(size) :]
            channels = 64
            for width in widths:
                layers += enlarged(channels, width, 2)
                channels = width
            layers += same(16, 16)
        self.trunk = nn.Sequential(*layers)
        self.colour, self.alpha = self._head(3), self._head(1)

    def _head(self, outputs: int) -> nn.Sequential:
        if self.deep_heads:
            return nn.Sequential(*same(16, 8), nn.Conv2d(8, outputs, 3, padding=1))
        return nn.Sequential(nn.Conv2d(16, outputs, 3, padding=1))

    def forward(
        self, what: Float[Tensor, "*batch Z"], alpha_only: bool = False
    ) -> Float[Tensor, "*batch C g g"]:
        """Channels: o (RGB), alpha; or alpha alone."""
        flat = what.reshape(-1, what.shape[-1])
        size = part_size(len(flat), 16 * self.size**2, flat)
        drawn = joined(self._decode(part, alpha_only) for part in flat.split(size))
        return drawn.reshape(*what.shape[:-1], *drawn.shape[1:])

    def _decode(self, what: Float[Tensor, "N Z"], alpha_only: bool) -> Float[Tensor, "N C g g"]:
        features = self.trunk(what[..., None, None])
        return torch.sigmoid(self.alpha(features) if alpha_only else self._heads(features))

    def _heads(self, features: Tensor) -> Tensor:
        """Both heads as one network, their hidden layers side by side."""
        heads = (self.colour, self.alpha)
        if not self.deep_heads:
            return self._together(features, *(head[0] for head in heads))
        hidden = F.celu_(self._together(features, *(head[0] for head in heads)))
        norms = [head[2] for head in heads]
        hidden = F.group_norm(
            hidden,
            sum(norm.num_groups for norm in norms),
            torch.cat([norm.weight for norm in norms]),
            torch.cat([norm.bias for norm in norms]),
            norms[0].eps,
        )
        colour, alpha = hidden.chunk(2, dim=1)
        return torch.cat([self.colour[3](colour), self.alpha[3](alpha)], dim=1)

    @staticmethod
    def _together(x: Tensor, *convs: nn.Conv2d) -> Tensor:
        """Convolutions of the same input as one."""
        biases = [conv.bias for conv in convs if conv.bias is not None]
        return F.conv2d(x, torch.cat([conv.weight for conv in convs]), torch.cat(biases), padding=1)
