"""Small networks of G-SWM: stacks of convolutions, encoders and decoders of glimpses (gswm.md sections 1 to 3)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.nn.layout import for_convolutions
from apex_lab.nn.splitting import joined, part_size

PER_GROUP = 16
"""Channels of a group in every GroupNorm of the published model."""

SMALL = 32
"""Side in pixels up to which another memory layout of images costs more than convolutions gain by it."""


def norm(channels: int) -> nn.GroupNorm:
    """GroupNorm with groups of 16 channels; narrower layers that are no multiple of 16 get the next best number."""
    return nn.GroupNorm(math.gcd(channels, max(1, channels // PER_GROUP)), channels)


def conv_stack(channels: int, widths: Sequence[int], first_kernel: int = 3) -> nn.Sequential:
    """Convolutions of stride 2, each followed by CELU and GroupNorm."""
    layers: list[nn.Module] = []
    for i, (inputs, outputs) in enumerate(itertools.pairwise([channels, *widths])):
        kernel = first_kernel if i == 0 else 3
        layers += [nn.Conv2d(inputs, outputs, kernel, 2, kernel // 2), nn.CELU(), norm(outputs)]
    return nn.Sequential(*layers)


def shuffle_stack(widths: Sequence[int], outputs: int) -> nn.Sequential:
    """Sub-pixel convolutions, each doubles the side; CELU and GroupNorm between them, a sigmoid at the end."""
    layers: list[nn.Module] = []
    for i, (inputs, after) in enumerate(itertools.pairwise([*widths, outputs])):
        layers += [nn.Conv2d(inputs, 4 * after, 3, padding=1), nn.PixelShuffle(2)]
        layers += [nn.Sigmoid()] if i == len(widths) - 1 else [nn.CELU(), norm(after)]
    return nn.Sequential(*layers)


def side_after(size: int, widths: Sequence[int], name: str) -> int:
    """Side of a square image after one halving per width.

    Raises:
        ValueError: it cannot be halved that often.
    """
    times = 2 ** len(widths)
    if size % times:
        raise ValueError(f"{name}={size} must be a multiple of {times}: it is halved {len(widths)} times")
    return size // times


class Encoder(nn.Module):
    """Square images -> codes: a stack of strided convolutions and one linear layer.

    Args:
        size: side of the images in pixels.
        widths: channels of the convolutions.
        outputs: length of the code.
        first_kernel: side of the first convolution's kernel.
        name: of the size, for messages.
    """

    def __init__(
        self, size: int, widths: Sequence[int], outputs: int, first_kernel: int = 3, name: str = "glimpse_size"
    ) -> None:
        super().__init__()
        side = side_after(size, widths, name)
        self.convs = conv_stack(3, widths, first_kernel)
        self.head = nn.Linear(widths[-1] * side**2, outputs)
        self._largest = widths[0] * (size // 2) ** 2

    def forward(self, images: Float[Tensor, "N 3 size size"]) -> Float[Tensor, "N outputs"]:
        if images.shape[-1] > SMALL:
            images = for_convolutions(images)
        parts = images.split(part_size(len(images), self._largest, images))
        return self.head(joined(self.convs(part).flatten(1) for part in parts))  # one gradient of the large weights


class Decoder(nn.Module):
    """Codes -> square images in [0, 1]: one linear layer and sub-pixel convolutions.

    Args:
        latent: length of the code.
        size: side of the images in pixels.
        widths: channels from the coarsest level to the finest.
        outputs: channels of the images.
        activation: a CELU after the linear layer.
        name: of the size, for messages.
    """

    def __init__(
        self,
        latent: int,
        size: int,
        widths: Sequence[int],
        outputs: int,
        activation: bool,
        name: str = "glimpse_size",
    ) -> None:
        super().__init__()
        side = side_after(size, widths, name)
        self.stem = nn.Linear(latent, widths[0] * side**2)
        shape: list[nn.Module] = [nn.Unflatten(1, (widths[0], side, side))]
        self.shape = nn.Sequential(nn.CELU(), *shape) if activation else nn.Sequential(*shape)
        self.convs = shuffle_stack(widths, outputs)
        self._largest = max(widths[-1], 4 * outputs) * (size // 2) ** 2

    def forward(self, codes: Float[Tensor, "N latent"]) -> Float[Tensor, "N outputs size size"]:
        parts = self.stem(codes).split(part_size(len(codes), self._largest, codes))
        return joined(self.convs(self.shape(part)) for part in parts)


def cell_head(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """A head of discovery: 1 x 1 convolutions, so every cell is read by itself but for the norms."""
    return nn.Sequential(
        nn.Conv2d(inputs, hidden, 1),
        nn.CELU(),
        norm(hidden),
        nn.Conv2d(hidden, hidden, 1),
        nn.CELU(),
        norm(hidden),
        nn.Conv2d(hidden, outputs, 1),
    )
