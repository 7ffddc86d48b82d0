"""Convolutional networks of SPACE (space.md sections 2, 3 and 5).

The foreground and all decoders of masks use convolution -> CELU -> GroupNorm, the background's encoders and its
component decoder use convolution -> BatchNorm -> ELU. Sizes follow the image size and are the published ones at 128.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.nn.parts import joined, part_size

PUBLISHED_SIZE = 128
"""Side in pixels of the images that SPACE was published for."""


def conv_celu(inputs: int, outputs: int, kernel: int, stride: int, padding: int, groups: int) -> nn.Sequential:
    """Convolution, CELU, GroupNorm: the order of the published code."""
    conv = nn.Conv2d(inputs, outputs, kernel, stride, padding)
    return nn.Sequential(conv, nn.CELU(inplace=True), nn.GroupNorm(groups, outputs))


def conv_elu(inputs: int, outputs: int, stride: int, padding: int) -> nn.Sequential:
    """3 x 3 convolution, BatchNorm, ELU."""
    conv = nn.Conv2d(inputs, outputs, 3, stride, padding)
    return nn.Sequential(conv, nn.BatchNorm2d(outputs), nn.ELU(inplace=True))


def upsample(inputs: int, outputs: int, factor: int, groups: int) -> nn.Sequential:
    """Sub-pixel stage: 1 x 1 convolution and pixel shuffle by `factor`, then a 3 x 3 convolution, each normalised."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs * factor**2, 1),
        nn.PixelShuffle(factor),
        nn.CELU(inplace=True),
        nn.GroupNorm(groups, outputs),
        *conv_celu(outputs, outputs, 3, 1, 1, groups),
    )


class ImageEncoder(nn.Module):
    """Image -> feature map of G x G (section 2).

    Five of the trunk's convolutions can halve the map; 128 pixels and G = 16, 8, 4 take 3, 4, 5 halvings. The first
    three always halve, then the fifth, then the fourth, as published; so other image sizes work with the G that
    3 to 5 halvings give.

    Args:
        image_size: H = W in pixels.
        grid: G.

    Raises:
        ValueError: no 3 to 5 halvings lead from `image_size` to `grid`.
    """

    def __init__(self, image_size: int, grid: int) -> None:
        super().__init__()
        halvings = math.log2(image_size / grid)
        if halvings not in (3, 4, 5):
            raise ValueError(
                f"model.grid={grid} must be an 8th, 16th or 32nd of model.image_size={image_size}: "
                f"set model.grid to one of {[image_size // 2**n for n in (3, 4, 5)]}"
            )
        self.trunk = nn.Sequential(
            conv_celu(3, 16, 4, 2, 1, groups=4),
            conv_celu(16, 32, 4, 2, 1, groups=8),
            conv_celu(32, 64, 4, 2, 1, groups=8),
            conv_celu(64, 128, 3, 2 if halvings >= 5 else 1, 1, groups=16),
            conv_celu(128, 256, 3, 2 if halvings >= 4 else 1, 1, groups=32),
            conv_celu(256, 128, 1, 1, 0, groups=16),
        )
        self.lateral = nn.Sequential(conv_celu(128, 128, 3, 1, 1, groups=16), conv_celu(128, 128, 3, 1, 1, groups=16))
        self.merge = conv_celu(256, 128, 3, 1, 1, groups=16)

    def forward(self, images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n 128 G G"]:
        trunk = self.trunk(images)
        return self.merge(torch.cat([trunk, self.lateral(trunk)], dim=1))


class GlimpseEncoder(nn.Module):
    """Crop -> mean and raw standard deviation of z_what (section 3).

    Args:
        size: 32 as published; 16 leaves out the last halving.
        what: length of z_what.
    """

    def __init__(self, size: int, what: int) -> None:
        super().__init__()
        last = conv_celu(64, 128, 4, 2, 1, groups=8) if size == 32 else conv_celu(64, 128, 3, 1, 1, groups=8)
        self.convs = nn.Sequential(
            conv_celu(3, 16, 3, 1, 1, groups=4),
            conv_celu(16, 32, 4, 2, 1, groups=8),
            conv_celu(32, 32, 3, 1, 1, groups=4),
            conv_celu(32, 64, 4, 2, 1, groups=8),
            last,
            conv_celu(128, 256, 4, 1, 0, groups=16),
            nn.Flatten(),
        )
        self.head = nn.Linear(256, 2 * what)
        self.largest = 16 * size**2

    def forward(self, crops: Float[Tensor, "m 3 g g"]) -> Float[Tensor, "m two_what"]:
        parts = crops.split(part_size(len(crops), self.largest, crops))
        return self.head(joined(self.convs(part) for part in parts))


class GlimpseDecoder(nn.Module):
    """z_what -> mask and RGB of a glimpse, both in (0, 1) (section 3).

    Args:
        size: 32 as published; 16 leaves out the second of the five doublings.
        what: length of z_what.
    """

    def __init__(self, size: int, what: int) -> None:
        super().__init__()
        stages = [(128, 16), (128, 16), (64, 8), (32, 8), (16, 4)]
        if size == 16:
            del stages[1]
        layers: list[nn.Module] = [conv_celu(what, 256, 1, 1, 0, groups=16)]
        inputs = 256
        for outputs, groups in stages:
            layers.append(upsample(inputs, outputs, 2, groups))
            inputs = outputs
        self.trunk = nn.Sequential(*layers)
        self.colour = nn.Conv2d(16, 3, 3, padding=1)
        self.mask = nn.Conv2d(16, 1, 3, padding=1)
        self.largest = 16 * size**2

    def forward(
        self, what: Float[Tensor, "m what"]
    ) -> tuple[Float[Tensor, "m 1 g g"], Float[Tensor, "m 3 g g"]]:
        size = part_size(len(what), self.largest, what)
        # one convolution for both heads
        weight = torch.cat([self.mask.weight, self.colour.weight])
        assert self.mask.bias is not None
        assert self.colour.bias is not None
        bias = torch.cat([self.mask.bias, self.colour.bias])
        drawn = joined(
            torch.sigmoid(F.conv2d(self.trunk(part), weight, bias, padding=1))
            for part in what[..., None, None].split(size)
        )
        return drawn[:, :1], drawn[:, 1:]


def factors_for(image_size: int, published: Sequence[int]) -> list[int]:
    """Up-sampling factors whose product is `image_size`, near those `published` for 128 pixels.

    A smaller image halves the last of the largest factors, a larger one doubles the first of the smallest, until the
    product fits.
    """
    factors = list(published)
    while math.prod(factors) > image_size:
        i = len(factors) - 1 - factors[::-1].index(max(factors))
        factors[i] //= 2
    while math.prod(factors) < image_size:
        factors[factors.index(min(factors))] *= 2
    return factors


class SubpixelDecoder(nn.Module):
    """Latent vector -> picture in (0, 1) by sub-pixel stages: mask decoder, and component decoder of K = 1 (section 5).

    Args:
        latent: length of the latent vector.
        image_size: side of the picture in pixels.
        stages: (factor at 128 pixels, channels, groups) of each stage.
        outputs: channels of the picture.
    """

    def __init__(self, latent: int, image_size: int, stages: Sequence[tuple[int, int, int]], outputs: int) -> None:
        super().__init__()
        layers: list[nn.Module] = [conv_celu(latent, 256, 1, 1, 0, groups=16)]
        inputs = 256
        factors = factors_for(image_size, [factor for factor, _, _ in stages])
        for factor, (_, channels, groups) in zip(factors, stages, strict=True):
            layers.append(upsample(inputs, channels, factor, groups))
            inputs = channels
        layers += [conv_celu(inputs, inputs, 3, 1, 1, groups=4), nn.Conv2d(inputs, outputs, 3, padding=1)]
        self.layers = nn.Sequential(*layers)
        self.largest = inputs * image_size**2

    def forward(self, latent: Float[Tensor, "m latent"]) -> Float[Tensor, "m outputs H W"]:
        size = part_size(len(latent), self.largest, latent)
        return joined(torch.sigmoid(self.layers(part)) for part in latent[..., None, None].split(size))


def mask_decoder(latent: int, image_size: int) -> SubpixelDecoder:
    """z_m -> u in (0, 1), the share of what is left that a component takes."""
    return SubpixelDecoder(latent, image_size, [(4, 256, 16), (2, 128, 16), (4, 64, 8), (4, 16, 4)], outputs=1)


def strong_decoder(latent: int, image_size: int) -> SubpixelDecoder:
    """z_c -> RGB for a background of a single component, which has no masks to compose from."""
    return SubpixelDecoder(latent, image_size, [(4, 256, 16), (4, 128, 16), (2, 64, 8), (4, 16, 4)], outputs=3)


class StridedEncoder(nn.Module):
    """Four strided convolutions and a linear layer: the background's image and component encoders (section 5).

    Args:
        image_size: H = W in pixels.
        channels: of the input and of the four convolutions.
        outputs: length of the code (linear).
    """

    def __init__(self, image_size: int, channels: Sequence[int], outputs: int) -> None:
        super().__init__()
        stages = [conv_elu(a, b, stride=2, padding=1) for a, b in zip(channels[:-1], channels[1:], strict=True)]
        self.convs = nn.Sequential(*stages, nn.Flatten())
        self.head = nn.Linear(channels[-1] * (image_size // 16) ** 2, outputs)

    def forward(self, images: Float[Tensor, "m C H W"]) -> Float[Tensor, "m outputs"]:
        return self.head(self.convs(images))


class BroadcastDecoder(nn.Module):
    """Spatial broadcast decoder, z_c -> RGB in (0, 1) (section 5).

    The input is z_c at every pixel of a map 8 pixels larger than the image, plus two channels of coordinates, and four
    unpadded convolutions bring it to the image's size.

    Args:
        latent: length of z_c.
        image_size: side of the image in pixels.
        width: channels of the convolutions; published: 32.
    """

    axis: Tensor

    def __init__(self, latent: int, image_size: int, width: int) -> None:
        super().__init__()
        self.register_buffer("axis", torch.linspace(-1, 1, image_size + 8), persistent=False)
        self.first = conv_elu(latent + 2, width, stride=1, padding=0)
        self.others = nn.Sequential(*(conv_elu(width, width, stride=1, padding=0) for _ in range(3)))
        self.head = nn.Conv2d(width, 3, 1)

    def forward(self, latent: Float[Tensor, "m latent"]) -> Float[Tensor, "m 3 H W"]:
        return torch.sigmoid(self.head(self.others(self._first(latent))))

    def _first(self, latent: Tensor) -> Tensor:
        """`self.first` of the broadcast map, without making that map.

        A convolution of a constant channel is a constant and the coordinates are the same for all, so its result is
        the sum of a vector per latent and one map. Their mean and variance over latents and pixels are the sums of
        theirs, so BatchNorm scales the two parts before they are added.
        """
        conv, norm = self.first[0], self.first[1]
        assert isinstance(conv, nn.Conv2d)
        assert isinstance(norm, nn.BatchNorm2d)
        length = latent.shape[1]
        by_latent = F.linear(latent, conv.weight[:, :length].sum((2, 3)), conv.bias)  # (m, width)
        y, x = torch.meshgrid(self.axis, self.axis, indexing="ij")
        by_place = F.conv2d(torch.stack([x, y])[None], conv.weight[:, length:])  # (1, width, H + 6, W + 6)
        with torch.autocast(latent.device.type, enabled=False):
            by_latent, by_place = by_latent.float(), by_place.float()
            mean, variance = _moments(norm, by_latent, by_place)
            gain = norm.weight * torch.rsqrt(variance + norm.eps)
            by_latent = by_latent * gain + (norm.bias - mean * gain)
            by_place = _cpu_layout(by_place * gain[:, None, None])
            return F.elu(by_latent[..., None, None] + by_place, inplace=True)


def _cpu_layout(x: Tensor) -> Tensor:
    """Channels last on a CPU, where unpadded convolutions and BatchNorm are faster so; what follows keeps the layout."""
    return x.contiguous(memory_format=torch.channels_last) if x.device.type == "cpu" else x


def _moments(
    norm: nn.BatchNorm2d, by_row: Float[Tensor, "m C"], by_place: Float[Tensor, "1 C h w"]
) -> tuple[Float[Tensor, " C"], Float[Tensor, " C"]]:
    """Mean and variance of `by_row` + `by_place` that BatchNorm divides by; in training, updates its running ones."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    if not norm.training:
        return norm.running_mean, norm.running_var
    mean = by_row.mean(0) + by_place.mean((0, 2, 3))
    variance = by_row.var(0, unbiased=False) + by_place.var((0, 2, 3), unbiased=False)
    count = by_row.shape[0] * by_place[0, 0].numel()
    with torch.no_grad():
        assert norm.momentum is not None
        norm.running_mean.lerp_(mean, norm.momentum)
        norm.running_var.lerp_(variance * (count / (count - 1)), norm.momentum)
        assert norm.num_batches_tracked is not None
        norm.num_batches_tracked.add_(1)
    return mean, variance
