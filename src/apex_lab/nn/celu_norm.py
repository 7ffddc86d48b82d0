"""CELU and then GroupNorm, the order of SPACE's and SCALOR's blocks, in fewer passes over memory on a CPU.

PyTorch's CELU computes `expm1`, which is slow there (`nn/rows.py`). Its GroupNorm of channels-last images, the layout
in which convolutions are fast, takes up to four times as long for few channels as that of images of contiguous planes.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from apex_lab.nn.rows import along_rows, elu, images_of, rows_of, sums, through_elu

FEW = 32
"""Up to so many channels, the written-out norm of channels-last images is faster than PyTorch's."""


class CeluGroupNorm(nn.GroupNorm):
    """GroupNorm of CELU(x), alpha 1; its parameters are a GroupNorm's. It may overwrite its input."""

    def forward(self, x: Float[Tensor, "n C h w"]) -> Float[Tensor, "n C h w"]:
        return celu_group_norm(x, self.num_groups, self.weight, self.bias, self.eps)


def celu_group_norm(
    x: Float[Tensor, "n C h w"],
    groups: int,
    weight: Float[Tensor, " C"],
    bias: Float[Tensor, " C"],
    eps: float = 1e-5,
) -> Float[Tensor, "n C h w"]:
    """GroupNorm of CELU(x), alpha 1, in the layout of x. It may overwrite x."""
    plain = x.device.type == "cpu" and x.dtype in (torch.float32, torch.float64) and not torch.compiler.is_compiling()
    if plain and x.numel() > 0:
        return _CeluGroupNorm.apply(x, groups, weight, bias, eps)
    return F.group_norm(F.celu_(x), groups, weight, bias, eps)


class _CeluGroupNorm(torch.autograd.Function):
    """Keeps CELU(x) alone for the backward pass."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, groups: int, weight: Tensor, bias: Tensor, eps: float) -> Tensor:  # type: ignore[override]
        y = elu(x if x.is_contiguous() else x.contiguous(memory_format=torch.channels_last))
        ctx.groups = groups
        if _by_rows(y):
            found, mean, inverse = _norm(y, groups, weight, bias, eps)
        else:
            found, mean, inverse = torch.ops.aten.native_group_norm(y, weight, bias, *_sizes(y), groups, eps)
        ctx.save_for_backward(y, weight, mean, inverse)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        y, weight, mean, inverse = ctx.saved_tensors
        if _by_rows(y):
            gradient = gradient.contiguous(memory_format=torch.channels_last)
            to_y, to_weight, to_bias = _norm_backward(gradient, y, mean, inverse, weight, ctx.groups)
        else:
            layout = torch.contiguous_format if y.is_contiguous() else torch.channels_last
            to_y, to_weight, to_bias = torch.ops.aten.native_group_norm_backward(
                gradient.contiguous(memory_format=layout), y, mean, inverse, weight, *_sizes(y), ctx.groups, [True] * 3
            )
        return through_elu(to_y, y), None, to_weight, to_bias, None


def _by_rows(y: Tensor) -> bool:
    return y.shape[1] <= FEW and not y.is_contiguous()


def _sizes(y: Tensor) -> tuple[int, int, int]:
    return len(y), y.shape[1], y.shape[2] * y.shape[3]


def _norm(y: Tensor, groups: int, weight: Tensor, bias: Tensor, eps: float) -> tuple[Tensor, Tensor, Tensor]:
    """GroupNorm of channels-last values; mean and 1 / std are (n, groups)."""
    rows, number = rows_of(y), y[0].numel() // groups
    mean = y.sum((2, 3)).unflatten(1, (groups, -1)).sum(2) / number
    work = (rows - _each(_channels(mean, y), y)).square_()
    inverse = torch.rsqrt(sums(work, y.shape[1]).unflatten(1, (groups, -1)).sum(2) / number + eps)
    gain = _channels(inverse, y) * weight
    torch.addcmul(_each(bias - _channels(mean, y) * gain, y), rows, _each(gain, y), out=work)
    return images_of(work, y.shape[1]), mean, inverse


def _norm_backward(
    gradient: Tensor, y: Tensor, mean: Tensor, inverse: Tensor, weight: Tensor, groups: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients with respect to y, weight and bias."""
    rows, number = rows_of(y), y[0].numel() // groups
    given = rows_of(gradient)
    work = given * rows
    product, plain = sums(work, y.shape[1]), gradient.sum((2, 3))  # (n, C)
    of_group = [(part * weight).unflatten(1, (groups, -1)).sum(2) for part in (product, plain)]
    slope = (of_group[1] * mean - of_group[0]) * inverse**3 / number
    still = -slope * mean - of_group[1] * inverse / number
    torch.addcmul(_each(_channels(still, y), y), rows, _each(_channels(slope, y), y), out=work)
    work.addcmul_(given, _each(_channels(inverse, y) * weight, y))
    to_weight = ((product - plain * _channels(mean, y)) * _channels(inverse, y)).sum(0)
    return images_of(work, y.shape[1]), to_weight, plain.sum(0)


def _channels(of_groups: Float[Tensor, "n groups"], like: Tensor) -> Float[Tensor, "n C"]:
    return of_groups.repeat_interleave(like.shape[1] // of_groups.shape[1], dim=1)


def _each(of_channels: Float[Tensor, "n C"], like: Tensor) -> Float[Tensor, "n 1 wC"]:
    return along_rows(of_channels, like.shape[3])
