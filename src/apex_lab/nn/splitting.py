"""Work on many images in parts that fit a processor's cache.

On a CPU, passes over tensors that outgrow its caches wait for memory; on a GPU, one large kernel beats many small ones.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

CACHED = 4 * 2**20
"""Bytes of the largest tensor of a part: several of them fit a CPU's last cache."""


def part_size(count: int, values_each: int, like: Tensor) -> int:
    """How many of `count` items to work on at once: all, but on a CPU as many as make tensors of `CACHED` bytes.

    Args:
        count: how many there are, at least 1.
        values_each: numbers that the largest tensor holds for each.
        like: a tensor of the device and type that they are worked on with.
    """
    if like.device.type != "cpu" or torch.compiler.is_compiling():  # a compiler would unroll the parts
        return count
    return max(1, min(count, CACHED // (values_each * like.element_size())))


def joined(parts: Iterable[Tensor]) -> Tensor:
    """Parts along the first dimension -> the whole."""
    first, *others = parts
    return torch.cat([first, *others]) if others else first
