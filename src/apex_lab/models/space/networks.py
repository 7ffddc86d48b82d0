"""Convolutional networks of SPACE (space.md sections 2, 3 and 5).

The foreground and all decoders of masks use convolution -> CELU -> GroupNorm, the background's encoders and its
component decoder use convolution -> BatchNorm -> ELU. Sizes follow the image size and are the published ones at 128.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.nn.celu_norm import CeluGroupNorm
from apex_lab.nn.splitting import joined, part_size
from apex_lab.nn.subpixel import SubPixelConv

PUBLISHED_SIZE = 128
"""Side in pixels of the images that SPACE was published for."""


def conv_celu(inputs: int, outputs: int, kernel: int, stride: int, padding: int, groups: int) -> nn.Sequential:
    """Convolution, CELU, GroupNorm: the order of the published code."""
    conv = nn.Conv2d(inputs, outputs, kernel, stride, padding)
    return nn.Sequential(conv, nn.Identity(), CeluGroupNorm(groups, outputs))  # Identity: as parameters are named


def conv_elu(inputs: int, outputs: int, stride: int, padding: int) -> nn.Sequential:
    """3 x 3 convolution, BatchNorm, ELU."""
    conv = nn.Conv2d(inputs, outputs, 3, stride, padding)
    return nn.Sequential(conv, BatchNorm(outputs), nn.ELU(inplace=True))


class BatchNorm(nn.BatchNorm2d):
    """BatchNorm whose statistics are exact on a CPU too.

    For channels-last images PyTorch (2.12) sums a channel's values one by one in single precision, in training. At 128
    pixels with K = 5 that moved the likelihood by 6e-5 of its value; with statistics from a reduction it is 2e-7.
    """

    def forward(self, x: Float[Tensor, "m C h w"]) -> Float[Tensor, "m C h w"]:
        if not self.training or x.device.type != "cpu" or x.dtype == torch.bfloat16:
            return super().forward(x)
        found, mean, variance = _Normalised.apply(x, self.weight, self.bias, self.eps)
        update_running(self, mean, variance, x.numel() // x.shape[1])
        return found


class _Normalised(torch.autograd.Function):
    """x, weight, bias, eps -> normalised x, and the channels' mean and biased variance (no gradient goes through)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, eps: float) -> tuple[Tensor, Tensor, Tensor]:  # type: ignore[override]
        mean = x.mean((0, 2, 3))
        variance = (x - mean[:, None, None]).square_().mean((0, 2, 3))  # torch.var takes three times as long
        ctx.save_for_backward(x, weight, mean, torch.rsqrt(variance + eps))
        ctx.eps = eps
        ctx.mark_non_differentiable(mean, variance)
        return F.batch_norm(x, mean, variance, weight, bias, eps=eps), mean, variance

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        x, weight, mean, inverse = ctx.saved_tensors
        inputs = (gradient, x, weight, None, None, mean, inverse, True, ctx.eps, [True] * 3)
        return *torch.ops.aten.native_batch_norm_backward(*inputs), None


def running(norm: nn.BatchNorm2d) -> tuple[Tensor, Tensor]:
    """Running mean and variance."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    return norm.running_mean, norm.running_var


@torch.no_grad()
def update_running(norm: nn.BatchNorm2d, mean: Tensor, variance: Tensor, count: int) -> None:
    """What BatchNorm does to its running statistics in training; `variance` is the biased one of `count` values."""
    running_mean, running_var = running(norm)
    assert norm.momentum is not None
    assert norm.num_batches_tracked is not None
    running_mean.lerp_(mean, norm.momentum)
    running_var.lerp_(variance * (count / (count - 1)), norm.momentum)
    norm.num_batches_tracked.add_(1)


def cpu_layout(x: Tensor) -> Tensor:
    """Channels last on a CPU, where convolutions to few channels, strided and unpadded ones, and BatchNorm are faster
    so; what follows keeps the layout."""
    return x.contiguous(memory_format=torch.channels_last) if x.device.type == "cpu" else x


def in_parts(layers: Callable[[Tensor], Tensor], x: Tensor, values_each: int) -> Tensor:
    """Layers on parts of x whose largest maps, of `values_each` numbers an item, fit a CPU's cache.

    First layers have small maps and large weights, so they take larger parts than the last ones.
    """
    return joined(layers(part) for part in x.split(part_size(len(x), values_each, x)))


def upsample(inputs: int, outputs: int, factor: int, groups: int) -> nn.Sequential:
    """Sub-pixel stage: 1 x 1 convolution and pixel shuffle by `factor`, then a 3 x 3 convolution, each normalised."""
    return nn.Sequential(
        SubPixelConv(inputs, outputs, factor),
        nn.Identity(),  # two: as parameters are named
        nn.Identity(),
        CeluGroupNorm(groups, outputs),
        *conv_celu(outputs, outputs, 3, 1, 1, groups),
    )


class WholeMap(nn.Conv2d):
    """A convolution whose kernel covers its whole input: on a CPU a linear layer, which takes 0.4 times as long."""

    def forward(self, x: Float[Tensor, "m C k k"]) -> Float[Tensor, "m outputs 1 1"]:
        if x.device.type != "cpu":
            return super().forward(x)
        return F.linear(x.flatten(1), self.weight.flatten(1), self.bias)[..., None, None]


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
        halvings = math.log2(image_size / grid) if image_size > 0 and grid > 0 else None
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
        trunk = self.trunk(cpu_layout(images))
        # in the usual layout: noise is drawn in that of what it is for
        return self.merge(torch.cat([trunk, self.lateral(trunk)], dim=1)).contiguous()


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
            nn.Sequential(WholeMap(128, 256, 4), nn.Identity(), CeluGroupNorm(16, 256)),
            nn.Flatten(),
        )
        self.head = nn.Linear(256, 2 * what)
        self.largest = 16 * size**2

    def forward(self, crops: Float[Tensor, "m 3 g g"]) -> Float[Tensor, "m two_what"]:
        return self.head(in_parts(lambda part: self.convs(cpu_layout(part)), crops, self.largest))


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
        self.small, self.large = stages[-2][0] * (size // 2) ** 2, 16 * size**2

    def forward(self, what: Float[Tensor, "m what"]) -> tuple[Float[Tensor, "m 1 g g"], Float[Tensor, "m 3 g g"]]:
        # one convolution for both heads
        weight = torch.cat([self.mask.weight, self.colour.weight])
        assert self.mask.bias is not None
        assert self.colour.bias is not None
        bias = torch.cat([self.mask.bias, self.colour.bias])
        before = in_parts(self.trunk[:-1], what[..., None, None], self.small)
        drawn = in_parts(
            lambda part: torch.sigmoid(F.conv2d(self.trunk[-1](part), weight, bias, padding=1)), before, self.large
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
        self.trunk = nn.Sequential(*layers, conv_celu(inputs, inputs, 3, 1, 1, groups=4))
        self.head = nn.Conv2d(inputs, outputs, 3, padding=1)
        before, last = stages[-2][1], factors[-1]
        self.small, self.large = before * (image_size // last) ** 2, inputs * image_size**2

    def forward(self, latent: Float[Tensor, "m latent"]) -> Float[Tensor, "m outputs H W"]:
        before = in_parts(self.trunk[:-2], latent[..., None, None], self.small)
        return in_parts(lambda part: torch.sigmoid(self.head(self.trunk[-2:](part))), before, self.large)


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
        stages = [conv_elu(a, b, stride=2, padding=1) for a, b in itertools.pairwise(channels)]
        self.convs = nn.Sequential(*stages, nn.Flatten())
        self.head = nn.Linear(channels[-1] * (image_size // 16) ** 2, outputs)

    def forward(self, images: Float[Tensor, "m C H W"]) -> Float[Tensor, "m outputs"]:
        return self.head(self.convs(cpu_layout(images)))
