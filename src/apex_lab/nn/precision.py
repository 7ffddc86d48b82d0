"""Full precision inside mixed precision, and inside TF32."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch
from torch import Tensor


def full(x: Tensor) -> Tensor:
    """Half precision as float32; float32 and float64 stay as they are."""
    return x.float() if x.dtype in (torch.float16, torch.bfloat16) else x


@contextlib.contextmanager
def full_products(device: torch.device) -> Iterator[None]:
    """Inside, float32 matrices are multiplied in float32, also where a GPU may take TF32 for the rest."""
    before = torch.get_float32_matmul_precision() if device.type == "cuda" else "highest"
    if before == "highest":
        yield
        return
    torch.set_float32_matmul_precision("highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
