"""Objects in slots."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


def gather_slots(values: Tensor, source: Int[Tensor, "*batch S"], dim: int = 1) -> Tensor:
    """Values whose K objects lie along `dim`, taken at `source` -> S objects there.

    The other dimensions of `source` are those of `values` before `dim`: values (B, K, ...) and source (B, S), or, with
    `dim` = 2, values (2, B, K, ...) and source (B, S), or values (B, T, K, ...) and source (B, T, S).
    """
    shape, size = [1] * values.dim(), list(values.shape)
    shape[dim + 1 - source.dim() : dim + 1] = source.shape
    size[dim] = source.shape[-1]
    return values.gather(dim, source.view(shape).expand(size))


def leading(valid: Bool[Tensor, "*batch P"]) -> int:
    """How many leading slots to work on, where the valid ones come first: at least 1; no valid one is left out.

    On a CPU as many as the fullest row has. A GPU would have to wait for that number, and a CUDA graph or a compiler
    takes one shape only, so there it is all.
    """
    slots = valid.shape[-1]
    if valid.device.type != "cpu" or torch.compiler.is_compiling():
        return slots
    return max(1, int(valid.sum(-1).max()))


def padded(values: Float[Tensor, "B n ..."], slots: int) -> Float[Tensor, "B P ..."]:
    """Values of the leading slots -> of all, zero behind them."""
    b, n = values.shape[:2]
    if n == slots:
        return values
    return torch.cat([values, values.new_zeros(b, slots - n, *values.shape[2:])], dim=1)
