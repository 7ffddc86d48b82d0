"""Convolution blocks of SCALOR: convolution, CELU, GroupNorm, in this order (scalor.md section 1)."""

from __future__ import annotations

from torch import Tensor, nn

from apex_lab.nn.layout import for_convolutions

GROUPS = {8: 4, 16: 4, 32: 8, 64: 8, 128: 16, 256: 16}
"""Groups of a GroupNorm by channels; the few layers that differ say so."""


class SubPixel(nn.PixelShuffle):
    """PixelShuffle, laid out for the layers that follow."""

    def forward(self, x: Tensor) -> Tensor:
        return for_convolutions(super().forward(x))


def _normalised(channels: int, groups: int | None) -> list[nn.Module]:
    # In place: autograd then keeps the activation once, as the norm's input, instead of also what came before it.
    return [nn.CELU(inplace=True), nn.GroupNorm(groups or GROUPS[channels], channels)]


def same(inputs: int, outputs: int, kernel: int = 3, groups: int | None = None) -> list[nn.Module]:
    """Keeps the resolution ("c3"; "c1" with `kernel` = 1)."""
    return [nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2), *_normalised(outputs, groups)]


def halved(inputs: int, outputs: int, groups: int | None = None) -> list[nn.Module]:
    """Halves the resolution ("s2": kernel 4, stride 2)."""
    return [nn.Conv2d(inputs, outputs, 4, stride=2, padding=1), *_normalised(outputs, groups)]


def enlarged(inputs: int, outputs: int, factor: int) -> list[nn.Module]:
    """Multiplies the resolution by `factor`: a 1 x 1 convolution to outputs * factor^2 channels, then PixelShuffle."""
    return [
        nn.Conv2d(inputs, outputs * factor**2, 1),
        SubPixel(factor),
        *_normalised(outputs, None),
    ]


def halvings(image_size: int, grid: int) -> int:
    """How often an image's side is halved to get to the grid's.

    Raises:
        ValueError: image_size / grid is not a power of two, or below 4.
    """
    ratio, rest = divmod(image_size, grid)
    if rest or ratio < 4 or ratio & (ratio - 1):
        raise ValueError(f"image_size={image_size} must be 4, 8, 16 or 32 times grid={grid}")
    return ratio.bit_length() - 1
