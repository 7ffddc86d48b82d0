"""Small building blocks: normalised convolutions, perceptrons, sub-pixel and broadcast decoders."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.nn.activations import MANY, Celu
from apex_lab.nn.layout import for_convolutions
from apex_lab.nn.slots import may_look
from apex_lab.nn.spatial_transformer import pixel_centres
from apex_lab.nn.splitting import joined, part_size


def group_norm(channels: int, per_group: int = 8) -> nn.GroupNorm:
    """GroupNorm with groups of about `per_group` channels; the number of groups divides `channels`."""
    return nn.GroupNorm(math.gcd(channels, max(1, channels // per_group)), channels)


def conv_norm(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    """Convolution, GroupNorm, ReLU."""
    conv = nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False)
    return nn.Sequential(conv, group_norm(outputs), nn.ReLU(inplace=True))


def mlp(sizes: Sequence[int]) -> nn.Sequential:
    """Linear layers with CELU between them; the last one is linear."""
    layers: list[nn.Module] = []
    for inputs, outputs in itertools.pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), nn.CELU()]
    return nn.Sequential(*layers[:-1])


class DoubledMaps(nn.PixelShuffle):
    """`nn.PixelShuffle` to twice the side; on a CPU fast for one channel too."""

    def __init__(self) -> None:
        super().__init__(2)

    def forward(self, x: Float[Tensor, "N C4 h w"]) -> Float[Tensor, "N C 2*h 2*w"]:
        if x.shape[1] != 4 or x.numel() < MANY or not may_look(x):
            return super().forward(x)
        # neighbours in a row, which stay so, move as one complex number
        pairs = torch.view_as_complex(x.permute(0, 2, 3, 1).contiguous().unflatten(3, (2, 2)))
        rows = torch.view_as_real(pairs.transpose(2, 3).contiguous())  # (N, h, 2, w, 2)
        return rows.flatten(3).flatten(1, 2)[:, None]


class _Maps(nn.Module):
    """Vectors -> feature maps (channels, side, side) of their values."""

    def __init__(self, channels: int, side: int) -> None:
        super().__init__()
        self.shape = (channels, side, side)

    def forward(self, x: Float[Tensor, "N values"]) -> Float[Tensor, "N C side side"]:
        return for_convolutions(x.unflatten(1, self.shape))


class GlimpseEncoder(nn.Module):
    """CNN from a crop to a vector: strided convolutions down to 4 x 4 or less, then one linear layer.

    A linear shortcut from the crop may add to the code, so that the crop's content is in it from the first step on.

    Args:
        channels: of the crop.
        size: side of the crop in pixels.
        width: channels of the convolutions.
        outputs: length of the code.
        shortcut: whether there is the shortcut.
    """

    def __init__(self, channels: int, size: int, width: int, outputs: int, shortcut: bool = True) -> None:
        super().__init__()
        layers: list[nn.Module] = [conv_norm(channels, width)]
        full = size
        while size > 4:
            layers.append(conv_norm(width, width, stride=2))
            size = (size + 1) // 2
        self.convs = nn.Sequential(*layers)
        self.head = nn.Sequential(nn.Linear(width * size * size, outputs), nn.CELU())
        self.shortcut = nn.Linear(channels * full * full, outputs, bias=False) if shortcut else None

    def forward(self, crops: Float[Tensor, "N C g g"]) -> Float[Tensor, "N outputs"]:
        code = self.head(self.convs(for_convolutions(crops)).flatten(1))
        return code if self.shortcut is None else code + self.shortcut(crops.flatten(1))


class SubpixelDecoder(nn.Module):
    """CNN from a latent vector to a square image: 4 x 4, then doubled by sub-pixel convolutions up to `size`.

    The last convolution is a sub-pixel one too, so nothing is computed at full size.

    Args:
        latent: length of the latent vector.
        size: side of the image in pixels, 4 times a power of two.
        width: channels at half the size; each level below has twice as many, at most 4 x.
        outputs: channels of the image (linear).
    """

    def __init__(self, latent: int, size: int, width: int, outputs: int) -> None:
        super().__init__()
        doublings = round(math.log2(size / 4))
        if doublings < 1 or 4 * 2**doublings != size:
            raise ValueError(f"a glimpse of {size} pixels is not 4 times a power of two, such as 16, 32 or 64")
        widths = [width * min(4, 2 ** (doublings - 1 - i)) for i in range(doublings)]
        self.stem = nn.Linear(latent, widths[0] * 16)
        blocks: list[nn.Module] = [_Maps(widths[0], 4), Celu()]
        for inputs, after in itertools.pairwise(widths):
            blocks += [nn.Conv2d(inputs, 4 * after, 3, padding=1), DoubledMaps(), group_norm(after), Celu()]
        self.blocks = nn.Sequential(*blocks)
        self.head = nn.Sequential(nn.Conv2d(width, 4 * outputs, 3, padding=1), DoubledMaps())
        self.largest = max(width, 4 * outputs) * (size // 2) ** 2

    def start_at(self, value: float) -> None:
        """Sets the last bias, so that an untrained decoder's images vary around `value`."""
        last = self.head[0]
        assert isinstance(last, nn.Conv2d)
        assert last.bias is not None
        nn.init.constant_(last.bias, value)

    def forward(self, latent: Float[Tensor, "N latent"]) -> Float[Tensor, "N outputs size size"]:
        size = part_size(len(latent), self.largest, latent)
        return joined(self.head(self.blocks(part)) for part in self.stem(latent).split(size))


class BroadcastDecoder(nn.Module):
    """Spatial broadcast decoder (Watters et al. 2019) on a coarse grid, brought to full size by sub-pixel convolutions.

    Args:
        latent: length of the latent vector.
        size: side of the image in pixels.
        width: channels.
        outputs: channels of the image (linear).
        coarse: the grid is `size / coarse`; a power of two, at least 2.
    """

    def __init__(self, latent: int, size: int, width: int, outputs: int, coarse: int = 8) -> None:
        super().__init__()
        if size % coarse:
            raise ValueError(f"image size {size} is not a multiple of {coarse}")
        self.grid = size // coarse
        self.stem = nn.Linear(latent, width)
        self.place = nn.Conv2d(2, width, 1)
        blocks: list[nn.Module] = [Celu(), nn.Conv2d(width, width, 3, padding=1), Celu()]
        for _ in range(round(math.log2(coarse)) - 1):
            blocks += [nn.Conv2d(width, 4 * width, 3, padding=1), DoubledMaps(), Celu()]
        self.blocks = nn.Sequential(*blocks)
        self.head = nn.Sequential(nn.Conv2d(width, 4 * outputs, 3, padding=1), DoubledMaps())

    def forward(self, latent: Float[Tensor, "N latent"]) -> Float[Tensor, "N outputs size size"]:
        axis = pixel_centres(self.grid, latent)
        coordinates = torch.stack(torch.meshgrid(axis, axis, indexing="ij"))[None]
        return self.head(self.blocks(for_convolutions(self.stem(latent)[..., None, None] + self.place(coordinates))))
