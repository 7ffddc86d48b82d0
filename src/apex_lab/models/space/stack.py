"""The layers of the broadcast decoder in training on a CPU, image by image (section 5).

Its maps are the largest tensors of a training step: 2.2 MB for each of n K pictures at 128 pixels. Layer by layer,
every normalisation and activation would read and write all of them, far more than a processor's cache holds, and wait
for memory. Image by image, what is read from memory is a convolution's output, once forward and twice backward; the
rest stays in the cache, and only those outputs are kept for the backward pass.

BatchNorm takes away whatever is the same for all pixels of a channel. So the convolutions leave out their bias and take
away the first image's means instead: plain sums of squares then lose nothing to rounding.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.nn.rows import along_rows, elu, images_of, rows_of, through_elu


class Statistics(NamedTuple):
    """Mean and biased variance of a layer's channels before normalisation, each (C,), of `number` values a channel."""

    mean: Tensor
    variance: Tensor
    number: int


class Scale(NamedTuple):
    """A layer's normalisation of its convolution's kept outputs, each (C,): their mean, 1 / std, gain and shift."""

    mean: Tensor
    inverse: Tensor
    gain: Tensor
    shift: Tensor

    def activated(self, outputs: Sequence[Float[Tensor, "1 C h w"]]) -> Iterator[Float[Tensor, "1 C h w"]]:
        """ELU of normalised outputs, image by image."""
        width, channels = outputs[0].shape[-1], len(self.gain)
        gain, shift = along_rows(self.gain[None], width), along_rows(self.shift[None], width)
        scaled, found = (torch.empty_like(rows_of(outputs[0])) for _ in range(2))
        for y in outputs:
            yield images_of(elu(torch.addcmul(shift, rows_of(y), gain, out=scaled), found), channels)


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
        scales: list[Scale] = []
        statistics: list[Tensor] = []
        inputs = _first(by_latent, by_place)
        for i, epsilon in enumerate(epsilons):
            kernel, offset, gain, shift = weights[4 * i : 4 * i + 4]
            made, around, mean, variance = _convolved(inputs, kernel)
            inverse = torch.rsqrt(variance + epsilon)
            gain = gain * inverse
            scales.append(Scale(mean, inverse, gain, shift - mean * gain))
            outputs.append(made)
            statistics += [around + mean + offset, variance]
            inputs = scales[-1].activated(made)
        drawn = torch.stack([torch.addmm(bias[:, None], head.flatten(1), _pixels(x).T) for x in inputs])
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
        scales, saved = [Scale(*saved[4 * i : 4 * i + 4]) for i in range(n)], saved[4 * n :]
        count = len(by_latent)
        outputs = [saved[count * i : count * (i + 1)] for i in range(n)]

        to_head, to_bias = torch.zeros_like(head), gradient.sum((0, 2, 3))
        passed: list[Tensor] = []  # gradients with respect to a layer's normalised values, of each image
        sums = _Sums()
        for m, x in enumerate(scales[-1].activated(outputs[-1])):
            each = gradient[m].flatten(1)  # (outputs, pixels)
            to_head += (each @ _pixels(x)).view_as(head)
            to_x = (each.T @ head.flatten(1)).unflatten(0, x.shape[-2:]).permute(2, 0, 1)[None]
            passed.append(through_elu(to_x, x))
            sums.add(passed[m], outputs[-1][m])

        to_weights: list[Tensor] = []
        to_latent, to_place = torch.empty_like(by_latent), torch.zeros_like(by_place)
        for i in reversed(range(n)):
            kernel, offset = weights[4 * i : 4 * i + 2]
            to_outputs, to_gain, to_shift = _through_norm(scales[i], sums, passed, outputs[i])
            sums = _Sums()
            to_kernel, to_offset = torch.zeros_like(kernel), torch.zeros_like(offset)
            inputs = scales[i - 1].activated(outputs[i - 1]) if i > 0 else _first(by_latent, by_place)
            for m, (to_y, x) in enumerate(zip(to_outputs, inputs, strict=True)):
                to_x, of_kernel, _ = torch.ops.aten.convolution_backward(
                    to_y, x, kernel, None, [1, 1], [0, 0], [1, 1], False, [0, 0], 1, [True, True, False]
                )
                to_kernel += of_kernel
                to_offset += to_y.sum((0, 2, 3))  # nothing but rounding
                passed[m] = through_elu(to_x, x)
                if i > 0:
                    sums.add(passed[m], outputs[i - 1][m])
                else:
                    to_latent[m] = passed[m].sum((0, 2, 3))
                    to_place += passed[m]
            to_weights = [to_kernel, to_offset, to_gain, to_shift, *to_weights]
        return None, to_latent, to_place, to_head, to_bias, *to_weights


def _first(by_latent: Float[Tensor, "m C"], by_place: Float[Tensor, "1 C h w"]) -> Iterator[Float[Tensor, "1 C h w"]]:
    """What the first convolution here sees, image by image."""
    place, channels = rows_of(by_place), by_latent.shape[1]
    added, found = (torch.empty_like(place) for _ in range(2))
    for each in by_latent:
        torch.add(place, along_rows(each[None], by_place.shape[-1]), out=added)
        yield images_of(elu(added, found), channels)


def _convolved(
    inputs: Iterator[Float[Tensor, "1 C h w"]], kernel: Tensor
) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
    """Convolutions minus the means of the first one; those means; and mean and biased variance of what is left."""
    made: list[Tensor] = []
    moments: list[Tensor] = []
    around = kernel.new_zeros(len(kernel))
    work = torch.empty(0, dtype=kernel.dtype)
    for x in inputs:
        y = F.conv2d(x, kernel, -around)
        if not made:
            around = y.mean((0, 2, 3))
            y -= around[:, None, None]
        made.append(y)
        work = work if len(work) else torch.empty_like(y)
        moments.append(torch.stack([y.mean((0, 2, 3)), torch.mul(y, y, out=work).mean((0, 2, 3))]))
    mean, square = torch.stack(moments).double().mean(0)
    return made, around, mean.to(kernel.dtype), (square - mean**2).clamp_min(0).to(kernel.dtype)


class _Sums:
    """What BatchNorm's gradient needs of all images: sums of the gradient, and of its product with a layer's outputs.

    Added while both are in the cache.
    """

    def __init__(self) -> None:
        self.each: list[Tensor] = []
        self.work: Tensor | None = None

    def add(self, gradient: Float[Tensor, "1 C h w"], output: Float[Tensor, "1 C h w"]) -> None:
        self.work = torch.empty_like(output) if self.work is None else self.work
        product = torch.mul(gradient, output, out=self.work)
        self.each.append(torch.stack([gradient.sum((0, 2, 3)), product.sum((0, 2, 3))]))


def _through_norm(
    scale: Scale, sums: _Sums, passed: Sequence[Tensor], outputs: Sequence[Tensor]
) -> tuple[Iterator[Float[Tensor, "1 C h w"]], Tensor, Tensor]:
    """Gradients with respect to a layer's normalised values -> to its outputs, image by image, to weight and bias.

    BatchNorm's gradient is gain (gradient - its mean - normalised value times the mean of their product).
    """
    channels, width = len(scale.gain), outputs[0].shape[-1]
    number = len(outputs) * outputs[0][0, 0].numel()
    plain, product = torch.stack(sums.each).double().sum(0)
    product = (product - scale.mean * plain) * scale.inverse
    slope = -scale.gain * scale.inverse * product / number
    still = -scale.gain * plain / number - slope * scale.mean
    kind = scale.gain.dtype
    rows = [along_rows(part.to(kind)[None], width) for part in (still, slope, scale.gain)]

    def to_outputs() -> Iterator[Tensor]:
        found = torch.empty_like(rows_of(outputs[0]))
        for g, y in zip(passed, outputs, strict=True):
            torch.addcmul(rows[0], rows_of(y), rows[1], out=found).addcmul_(rows_of(g), rows[2])
            yield images_of(found, channels)

    return to_outputs(), product.to(kind), plain.to(kind)


def _pixels(x: Float[Tensor, "1 C h w"]) -> Float[Tensor, "pixels C"]:
    """A view of channels-last values."""
    return x.permute(0, 2, 3, 1).flatten(0, 2)
