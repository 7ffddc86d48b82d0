"""The layers of the broadcast decoder in training on a CPU, image by image (section 5).

Its maps are the largest tensors of a training step: 2.2 MB for each of n K pictures at 128 pixels. Layer by layer,
every normalisation and activation would read and write all of them, far more than a processor's cache holds, and wait
for memory. Image by image, what is read from memory is a convolution's output, once forward and twice backward; the
rest stays in the cache, and only those outputs are kept for the backward pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn


class Statistics(NamedTuple):
    """Mean and biased variance of a layer's channels before normalisation, each (C,), of `number` values a channel."""

    mean: Tensor
    variance: Tensor
    number: int


class Scaled(NamedTuple):
    """A normalisation, each (C, 1, 1): values minus `mean`, times `gain`, plus `shift`; `inverse` is 1 / std."""

    mean: Tensor
    inverse: Tensor
    gain: Tensor
    shift: Tensor

    def activated(self, centred: Tensor) -> Tensor:
        """ELU of the normalised values."""
        return F.elu_(torch.addcmul(self.shift, centred, self.gain))


def draw(
    by_latent: Float[Tensor, "m C"],
    by_place: Float[Tensor, "1 C h w"],
    layers: Sequence[tuple[nn.Conv2d, nn.BatchNorm2d]],
    head: nn.Conv2d,
) -> tuple[Float[Tensor, "m outputs H W"], list[Statistics]]:
    """ELU of the sum of both maps, then convolution, BatchNorm of this batch, ELU for each layer, then a 1 x 1 head.

    Running statistics are not touched: what they need is returned.
    """
    weights = [w for conv, norm in layers for w in (conv.weight, conv.bias, norm.weight, norm.bias)]
    drawn, *found = _Stack.apply(
        [norm.eps for _, norm in layers], by_latent, by_place, head.weight, head.bias, *weights
    )
    area = by_place.shape[-1]
    numbers = [len(by_latent) * (area - 2 * (i + 1)) ** 2 for i in range(len(layers))]
    return drawn, [Statistics(found[2 * i], found[2 * i + 1], number) for i, number in enumerate(numbers)]


class _Stack(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        epsilons: list[float],
        by_latent: Tensor,
        by_place: Tensor,
        head: Tensor,
        bias: Tensor,
        *weights: Tensor,
    ) -> tuple[Tensor, ...]:
        outputs: list[list[Tensor]] = []
        scales: list[Scaled] = []
        statistics: list[Tensor] = []
        for i, epsilon in enumerate(epsilons):
            kernel, offset, gain, shift = weights[4 * i : 4 * i + 4]
            moments = _Moments()
            made = []
            for m in range(len(by_latent)):
                x = _first(by_latent, by_place, m) if i == 0 else scales[-1].activated(outputs[-1][m] - scales[-1].mean)
                made.append(F.conv2d(x, kernel, offset))
                moments.add(made[-1])
            mean, variance = moments.found()
            inverse = torch.rsqrt(variance + epsilon)
            each = (mean, inverse, gain * inverse, shift)
            outputs.append(made)
            scales.append(Scaled(*(part[:, None, None] for part in each)))
            statistics += [mean, variance]
        pixels = (_pixels(scales[-1].activated(y - scales[-1].mean)) for y in outputs[-1])
        drawn = torch.stack([torch.addmm(bias, each, head.flatten(1).T).T for each in pixels])
        flat = [y for made in outputs for y in made]
        ctx.save_for_backward(by_latent, by_place, head, *weights, *(part for scale in scales for part in scale), *flat)
        ctx.layers = len(epsilons)
        ctx.mark_non_differentiable(*statistics)
        return drawn.unflatten(2, outputs[-1][0].shape[-2:]), *statistics

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        saved, n = list(ctx.saved_tensors), ctx.layers
        by_latent, by_place, head = saved[:3]
        weights, saved = saved[3 : 3 + 4 * n], saved[3 + 4 * n :]
        scales, saved = [Scaled(*saved[4 * i : 4 * i + 4]) for i in range(n)], saved[4 * n :]
        count = len(by_latent)
        outputs = [saved[count * i : count * (i + 1)] for i in range(n)]

        to_head, to_bias = torch.zeros_like(head), gradient.sum((0, 2, 3))
        passed: list[Tensor] = []  # gradients with respect to a layer's normalised values, of each image
        sums = _Sums()
        for m, y in enumerate(outputs[-1]):
            centred = y - scales[-1].mean
            x = scales[-1].activated(centred)
            each = gradient[m].flatten(1)  # (outputs, pixels)
            to_head += (each @ _pixels(x)).view_as(head)
            to_x = (each.T @ head.flatten(1)).unflatten(0, x.shape[-2:]).permute(2, 0, 1)[None]
            passed.append(_through_elu(to_x, x))
            sums.add(passed[-1], centred)

        to_weights: list[Tensor] = []
        to_latent, to_place = torch.empty_like(by_latent), torch.zeros_like(by_place)
        for i in reversed(range(n)):
            scale, (kernel, _, _, _) = scales[i], weights[4 * i : 4 * i + 4]
            still, slope, to_gain, to_shift = sums.found(scale, count * outputs[i][0][0, 0].numel())
            to_kernel, to_offset = torch.zeros_like(kernel), torch.zeros_like(to_shift)
            sums = _Sums()
            for m in range(count):
                # BatchNorm's gradient: gain (gradient - its mean - normalised value times its product's mean)
                to_y = torch.addcmul(still, outputs[i][m] - scale.mean, slope).addcmul_(passed[m], scale.gain)
                centred = None if i == 0 else outputs[i - 1][m] - scales[i - 1].mean
                x = _first(by_latent, by_place, m) if centred is None else scales[i - 1].activated(centred)
                to_x, of_kernel, of_offset = torch.ops.aten.convolution_backward(
                    to_y, x, kernel, [len(kernel)], [1, 1], [0, 0], [1, 1], False, [0, 0], 1, [True] * 3
                )
                to_kernel += of_kernel
                to_offset += of_offset
                passed[m] = _through_elu(to_x, x)
                if centred is not None:
                    sums.add(passed[m], centred)
                else:
                    to_latent[m] = passed[m].sum((0, 2, 3))
                    to_place += passed[m]
            to_weights = [to_kernel, to_offset, to_gain, to_shift, *to_weights]
        return None, to_latent, to_place, to_head, to_bias, *to_weights


class _Moments:
    """Mean and variance over images that come one by one, by the sums of each around its own mean."""

    def __init__(self) -> None:
        self.each: list[tuple[Tensor, Tensor]] = []

    def add(self, y: Float[Tensor, "1 C h w"]) -> None:
        mean = y.mean((0, 2, 3))
        self.each.append((mean, (y - mean[:, None, None]).square_().mean((0, 2, 3))))

    def found(self) -> tuple[Float[Tensor, " C"], Float[Tensor, " C"]]:
        means, variances = (torch.stack(part).double() for part in zip(*self.each, strict=True))
        kind = self.each[0][0].dtype
        return means.mean(0).to(kind), (variances.mean(0) + means.var(0, unbiased=False)).to(kind)


class _Sums:
    """Sums over images that BatchNorm's gradient needs: of the gradient, and of its product with the centred values."""

    def __init__(self) -> None:
        self.each: list[tuple[Tensor, Tensor]] = []

    def add(self, gradient: Float[Tensor, "1 C h w"], centred: Float[Tensor, "1 C h w"]) -> None:
        self.each.append((gradient.sum((0, 2, 3)), (gradient * centred).sum((0, 2, 3))))

    def found(self, scale: Scaled, count: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Constant and slope of what is added to gain times gradient; gradients of BatchNorm's weight and bias."""
        kind = self.each[0][0].dtype
        plain, product = (torch.stack(part).double().sum(0).to(kind) for part in zip(*self.each, strict=True))
        still = -scale.gain * (plain / count)[:, None, None]
        slope = -scale.gain * scale.inverse.square() * (product / count)[:, None, None]
        return still, slope, product * scale.inverse.flatten(), plain


def _first(by_latent: Tensor, by_place: Tensor, m: int) -> Float[Tensor, "1 C h w"]:
    """What the first convolution here sees of image m."""
    return F.elu_(by_place + by_latent[m, :, None, None])


def _pixels(x: Float[Tensor, "1 C h w"]) -> Float[Tensor, "pixels C"]:
    """A view of channels-last values."""
    return x.permute(0, 2, 3, 1).flatten(0, 2)


def _through_elu(gradient: Tensor, after: Tensor) -> Tensor:
    return torch.ops.aten.elu_backward(gradient, 1, 1, 1, True, after)  # True: from the ELU's output
