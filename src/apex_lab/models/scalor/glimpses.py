"""Glimpse networks, shared by discovery and propagation (scalor.md section 7)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.models.scalor.blocks import GROUPS, enlarged, halved, same
from apex_lab.models.scalor.latents import full_precision
from apex_lab.nn.celu_stack import Block, Layer, fast_on, run_stack, side_by_side, stack_of
from apex_lab.nn.layout import for_convolutions
from apex_lab.nn.spatial_transformer import crop, sampled_crop
from apex_lab.nn.splitting import joined, part_size

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
        if fast_on(glimpses):
            head = Block(Layer(1, 0), self.head.weight[..., None, None], self.head.bias)
            return run_stack([*stack_of(self.stack), head], glimpses, len(glimpses)).flatten(1)
        return self.head(self.stack(for_convolutions(glimpses)).flatten(1))

    def _cut(self, images: Tensor, windows: Tensor) -> Float[Tensor, "BK 3 g g"]:
        with full_precision(images):
            if fast_on(images) and not images.requires_grad:
                return sampled_crop(images, windows, self.size).flatten(0, 1)
            return crop(images, windows, self.size).flatten(0, 1)

    def forward(self, images: Float[Tensor, "B 3 H W"], windows: Float[Tensor, "B K 4"]) -> Float[Tensor, "B K two_Z"]:
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
        self.size = size
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
        self.colour, self.alpha = Head(3, deep_heads), Head(1, deep_heads)

    def forward(
        self, what: Float[Tensor, "*batch Z"], alpha_only: bool = False, keep: bool = True
    ) -> Float[Tensor, "*batch C g g"]:
        """Channels: o (RGB), alpha; or alpha alone.

        Args:
            what: codes.
            alpha_only: leave o out.
            keep: keep activations for the backward pass, where `celu_stack` runs the network; else that pass draws
                part by part again.
        """
        flat = what.reshape(-1, what.shape[-1])
        if fast_on(flat):
            stack = self._stack(alpha_only)
            drawn = torch.sigmoid(run_stack(stack, flat[..., None, None], self._each(flat), keep))
        else:
            drawn = joined(self._decode(part, alpha_only) for part in flat.split(self._each(flat)))
        return drawn.reshape(*what.shape[:-1], *drawn.shape[1:])

    def _each(self, flat: Float[Tensor, "N Z"]) -> int:
        return part_size(len(flat), 16 * self.size**2, flat)

    def _decode(self, what: Float[Tensor, "N Z"], alpha_only: bool) -> Float[Tensor, "N C g g"]:
        features = self.trunk(what[..., None, None])
        return torch.sigmoid(self.alpha(features) if alpha_only else self._heads(features))

    def _stack(self, alpha_only: bool) -> list[Block]:
        """Trunk and heads as one network."""
        alpha = stack_of(self.alpha.layers())
        heads = alpha if alpha_only else side_by_side(stack_of(self.colour.layers()), alpha)
        return [*stack_of(self.trunk), *heads]

    def _heads(self, features: Tensor) -> Tensor:
        """Both heads as one network, their hidden layers side by side."""
        a, b = self.colour, self.alpha
        if a.hidden is None or a.norm is None or b.hidden is None or b.norm is None:
            return _together(features, a.out, b.out)
        hidden = F.celu_(_together(features, a.hidden, b.hidden))
        weight, bias = (torch.cat([getattr(a.norm, name), getattr(b.norm, name)]) for name in ("weight", "bias"))
        hidden = F.group_norm(hidden, a.norm.num_groups + b.norm.num_groups, weight, bias, a.norm.eps)
        colour, alpha = hidden.chunk(2, dim=1)
        return torch.cat([a.out(colour), b.out(alpha)], dim=1)


class Head(nn.Module):
    """Last layers of the glimpse decoder, for one of its outputs.

    Args:
        outputs: channels.
        deep: with a hidden layer.
    """

    def __init__(self, outputs: int, deep: bool) -> None:
        super().__init__()
        self.hidden = nn.Conv2d(16, 8, 3, padding=1) if deep else None
        self.norm = nn.GroupNorm(GROUPS[8], 8) if deep else None
        self.out = nn.Conv2d(8 if deep else 16, outputs, 3, padding=1)

    def layers(self) -> list[nn.Module]:
        """One after the other."""
        return [self.out] if self.hidden is None or self.norm is None else [self.hidden, nn.CELU(), self.norm, self.out]

    def forward(self, features: Float[Tensor, "N 16 g g"]) -> Float[Tensor, "N outputs g g"]:
        if self.hidden is not None and self.norm is not None:
            features = self.norm(F.celu_(self.hidden(features)))
        return self.out(features)


def _together(x: Tensor, a: nn.Conv2d, b: nn.Conv2d) -> Tensor:
    """Two convolutions of the same input as one."""
    assert a.bias is not None
    assert b.bias is not None
    return F.conv2d(x, torch.cat([a.weight, b.weight]), torch.cat([a.bias, b.bias]), padding=1)
