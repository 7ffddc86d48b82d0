"""Stacks of convolution, sub-pixel shuffle, CELU and GroupNorm in training on a CPU, part by part.

Layer by layer, each activation and normalisation is a pass over all images, and waits for memory. Here a part of the
images goes through all layers while it is in the cache. The gradient is written out: of each layer one map is kept, the
CELU's output, where autograd keeps two; what the next convolution saw follows from it by one multiplication and
addition per value. Results and gradients are those of the layers one by one, up to rounding.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from apex_lab.nn.layout import for_convolutions
from apex_lab.nn.rows import along_rows, elu, images_of, rows_of, sums, through_elu


class Layer(NamedTuple):
    """stride, padding: of the convolution. factor: of the sub-pixel shuffle, 1 for none. groups, eps: of the norm."""

    stride: int
    padding: int
    factor: int = 1
    groups: int = 0
    eps: float = 1e-5


class Block(NamedTuple):
    """One layer with the weights of its convolution and its norm; the last of a stack is a convolution alone.

    Before a shuffle, the convolution's outputs are in the order (row, column, channel) of what they become.
    """

    layer: Layer
    weight: Tensor
    bias: Tensor
    gain: Tensor | None = None
    shift: Tensor | None = None


class _Normalised(NamedTuple):
    """CELU's output (N, C, h, w) before its normalisation; mean and 1 / std of its groups, each (N, groups)."""

    values: Tensor
    mean: Tensor
    inverse: Tensor


def fast_on(x: Tensor) -> bool:
    """Whether stacks run here: on a CPU in one precision, and not where a compiler traces."""
    return x.device.type == "cpu" and not torch.compiler.is_compiling() and not torch.is_autocast_enabled("cpu")


def stack_of(modules: Iterable[nn.Module]) -> list[Block]:
    """Takes layers apart: Conv2d, perhaps PixelShuffle, CELU, GroupNorm.

    Raises:
        TypeError: a module is none of these.
    """
    stack: list[Block] = []
    for module in modules:
        if isinstance(module, nn.Conv2d):
            assert module.bias is not None
            stack.append(Block(Layer(module.stride[0], int(module.padding[0])), module.weight, module.bias))
        elif isinstance(module, nn.PixelShuffle):
            last, split = stack[-1], (-1, module.upscale_factor, module.upscale_factor)
            weight, bias = (x.unflatten(0, split).movedim(0, 2).flatten(0, 2) for x in (last.weight, last.bias))
            stack[-1] = Block(last.layer._replace(factor=module.upscale_factor), weight, bias)
        elif isinstance(module, nn.GroupNorm):
            layer = stack[-1].layer._replace(groups=module.num_groups, eps=module.eps)
            stack[-1] = stack[-1]._replace(layer=layer, gain=module.weight, shift=module.bias)
        elif not (isinstance(module, nn.CELU) and module.alpha == 1):
            raise TypeError(f"{module} is no layer of a stack of convolution, sub-pixel shuffle, CELU and GroupNorm")
    return stack


def side_by_side(a: list[Block], b: list[Block]) -> list[Block]:
    """Two stacks of the same layers and the same input as one: channels of `a`, then of `b`."""
    both: list[Block] = []
    for first, other in zip(a, b, strict=True):
        weights = first.weight, other.weight
        if both:  # each sees its own inputs
            n, m = first.weight.shape[1], other.weight.shape[1]
            weights = F.pad(first.weight, (0, 0, 0, 0, 0, m)), F.pad(other.weight, (0, 0, 0, 0, n, 0))
        bias = torch.cat([first.bias, other.bias])
        if first.gain is None or first.shift is None or other.gain is None or other.shift is None:
            both.append(Block(first.layer, torch.cat(weights), bias))
        else:
            layer = first.layer._replace(groups=first.layer.groups + other.layer.groups)
            gain, shift = torch.cat([first.gain, other.gain]), torch.cat([first.shift, other.shift])
            both.append(Block(layer, torch.cat(weights), bias, gain, shift))
    return both


def run_layers(layers: nn.Sequential, x: Float[Tensor, "N C h w"]) -> Float[Tensor, "N D H W"]:
    """The layers' output for images that are one part; by the layers themselves where stacks do not run.

    The last layer is a convolution alone.
    """
    if fast_on(x):
        return run_stack(stack_of(layers), x, len(x))
    return layers(for_convolutions(x))


def run_stack(
    stack: list[Block], x: Float[Tensor, "N C h w"], each: int, keep: bool = True
) -> Float[Tensor, "N D H W"]:
    """The stack's output, contiguous.

    Args:
        stack: layers; only the last one is without a norm.
        x: images.
        each: images of a part.
        keep: keeps a map of each layer for the backward pass; else that pass runs the stack a second time.
    """
    layers = [block.layer for block in stack]
    weights = [weight for block in stack for weight in block[1:] if weight is not None]
    if torch.is_grad_enabled():
        return _Stack.apply(layers, each, keep, x, *weights)
    return _joined([_forward(layers, weights, part)[0] for part in x.split(each)])


def _joined(parts: list[Tensor]) -> Tensor:
    whole = parts[0].new_empty((sum(map(len, parts)), *parts[0].shape[1:]))  # contiguous, as torch.cat need not be
    return torch.cat(parts, out=whole)


class _Stack(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, layers: list[Layer], each: int, keep: bool, x: Tensor, *weights: Tensor
    ) -> Tensor:
        ctx.layers, ctx.each, ctx.keep, ctx.weights = layers, each, keep, len(weights)
        outputs, kept = [], []
        for part in x.split(each):
            output, maps = _forward(layers, weights, part)
            outputs.append(output)
            if keep:
                kept += [value for one in maps for value in one]
        ctx.save_for_backward(x, *weights, *kept)
        return _joined(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, on_output: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        x, *saved = ctx.saved_tensors
        weights, kept = saved[: ctx.weights], saved[ctx.weights :]
        number = 3 * (len(ctx.layers) - 1)
        on_x: list[Tensor] = []
        on_weights: list[Tensor] = []
        for i, (part, on_part) in enumerate(zip(x.split(ctx.each), on_output.split(ctx.each), strict=True)):
            if ctx.keep:
                mine = kept[number * i : number * (i + 1)]
                maps = [_Normalised(*mine[j : j + 3]) for j in range(0, number, 3)]
            else:
                maps = _forward(ctx.layers, weights, part)[1]
            on_it, found = _backward(ctx.layers, weights, part, maps, on_part, ctx.needs_input_grad[3])
            if on_it is not None:
                on_x.append(on_it)
            on_weights = [a.add_(b) for a, b in zip(on_weights, found, strict=True)] if on_weights else found
        return None, None, None, torch.cat(on_x) if on_x else None, *on_weights


def _forward(layers: list[Layer], weights: Sequence[Tensor], x: Tensor) -> tuple[Tensor, list[_Normalised]]:
    kept = []
    x = for_convolutions(x)
    for i, layer in enumerate(layers[:-1]):
        weight, bias, gain, shift = weights[4 * i : 4 * i + 4]
        values = _shuffled(F.conv2d(x, weight, bias, layer.stride, layer.padding), layer.factor)
        values = elu(values)  # with alpha 1, CELU is ELU
        n, c, h, w = values.shape
        x, mean, inverse = torch.native_group_norm(values, gain, shift, n, c, h * w, layer.groups, layer.eps)
        kept.append(_Normalised(values, mean, inverse))
    return F.conv2d(x, weights[-2], weights[-1], 1, layers[-1].padding), kept


def _backward(
    layers: list[Layer],
    weights: Sequence[Tensor],
    first: Tensor,
    maps: list[_Normalised],
    gradient: Tensor,
    to_first: bool,
) -> tuple[Tensor | None, list[Tensor]]:
    """Gradients with respect to the stack's input, if asked for, and to its weights."""
    found: list[Tensor] = []
    gradient = for_convolutions(gradient)
    for i in reversed(range(len(layers))):
        layer = layers[i]
        of_norm: tuple[Tensor, ...] = ()
        if i < len(layers) - 1:
            gradient, *of_norm = _through_norm(gradient, maps[i], weights[4 * i + 2])  # type: ignore[assignment]
            gradient = _unshuffled(gradient, layer.factor)
        x = _restored(maps[i - 1], *weights[4 * i - 2 : 4 * i]) if i else for_convolutions(first)
        weight = weights[4 * i]
        gradient, *of_conv = torch.ops.aten.convolution_backward(
            gradient, x, weight, [len(weight)], [layer.stride] * 2, [layer.padding] * 2, [1, 1], False, [0, 0], 1,
            [i > 0 or to_first, True, True],
        )  # fmt: skip
        found = [*of_conv, *of_norm, *found]
    return gradient if to_first else None, found


def _restored(norm: _Normalised, gain: Tensor, shift: Tensor) -> Float[Tensor, "N C h w"]:
    """The normalisation's output, from its input."""
    scale = (norm.inverse[..., None] * gain.view(norm.inverse.shape[1], -1)).flatten(1)
    offset = shift - (norm.mean[..., None] * scale.view(*norm.mean.shape, -1)).flatten(1)
    _, c, _, w = norm.values.shape
    return images_of(torch.addcmul(along_rows(offset, w), rows_of(norm.values), along_rows(scale, w)), c)


def _through_norm(
    gradient: Float[Tensor, "N C h w"], norm: _Normalised, gain: Float[Tensor, " C"]
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients with respect to the CELU's input and to the norm's weight and bias."""
    n, c, h, w = gradient.shape
    groups = norm.mean.shape[1]
    rows, values = rows_of(gradient), rows_of(norm.values)
    plain, product = sums(rows, c), sums(rows * values, c)
    still, slope = ((gain * s).view(n, groups, -1).sum(-1) for s in (plain, product))
    number = c // groups * h * w
    slope = (still * norm.mean - slope) * norm.inverse.pow(3) / number
    still = -slope * norm.mean - still * norm.inverse / number
    mean, inverse, slope, still = (
        s[..., None].expand(-1, -1, c // groups).flatten(1) for s in (norm.mean, norm.inverse, slope, still)
    )
    back = torch.addcmul(along_rows(still, w), values, along_rows(slope, w))
    back.addcmul_(rows, along_rows(inverse * gain, w))
    return images_of(through_elu(back, values), c), ((product - mean * plain) * inverse).sum(0), plain.sum(0)


def _shuffled(x: Float[Tensor, "N ffC h w"], factor: int) -> Float[Tensor, "N C fh fw"]:
    """Sub-pixel shuffle of channels-last values whose channels come last in the order of channels."""
    if factor == 1:
        return x
    n, c, h, w = x.shape
    pixels = x.permute(0, 2, 3, 1).reshape(n, h, w, factor, -1).transpose(2, 3)
    return pixels.reshape(n, factor * h, factor * w, c // factor**2).permute(0, 3, 1, 2)


def _unshuffled(x: Float[Tensor, "N C fh fw"], factor: int) -> Float[Tensor, "N ffC h w"]:
    if factor == 1:
        return x
    n, c, h, w = x.shape
    pixels = x.permute(0, 2, 3, 1).reshape(n, h // factor, factor, w // factor, factor * c).transpose(2, 3)
    return pixels.reshape(n, h // factor, w // factor, factor**2 * c).permute(0, 3, 1, 2)
