"""Activations that are fast on a CPU are PyTorch's to rounding, and so are their gradients."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from apex_lab.nn.activations import MANY, Celu, exp, exp_, tanh


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-14), (torch.float32, 3e-7)])
@pytest.mark.parametrize("count", [10, 2 * MANY])
@pytest.mark.parametrize(("ours", "theirs"), [(tanh, torch.tanh), (Celu(), nn.CELU())], ids=["tanh", "celu"])
def test_as_pytorch(
    ours: Callable[[Tensor], Tensor],
    theirs: Callable[[Tensor], Tensor],
    count: int,
    dtype: torch.dtype,
    tolerance: float,
) -> None:
    x = torch.linspace(-12, 12, count, dtype=dtype).reshape(1, 2, -1, 1).contiguous(memory_format=torch.channels_last)
    x = torch.cat([x, torch.zeros_like(x)])
    found, wanted = (x.clone().requires_grad_() for _ in range(2))
    a, b = ours(found), theirs(wanted)
    torch.testing.assert_close(a, b, rtol=0, atol=tolerance)
    assert a.stride() == b.stride()
    for result in (a, b):
        (result * torch.linspace(-1, 1, x.numel(), dtype=dtype).view_as(x)).sum().backward()
    torch.testing.assert_close(found.grad, wanted.grad, rtol=0, atol=tolerance)


def test_exp() -> None:
    x = torch.linspace(-20, 10, 999)
    torch.testing.assert_close(exp(x), x.exp(), rtol=3e-6, atol=0)
    torch.testing.assert_close(exp(x.double()), x.double().exp(), rtol=1e-14, atol=0)
    assert torch.equal(exp_(x.clone()), exp(x))
    assert exp(torch.tensor([-torch.inf])) == 0
