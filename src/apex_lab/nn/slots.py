"""Objects in slots."""

from __future__ import annotations

from jaxtyping import Int
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
