"""CELU and GroupNorm as one function against the two."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from apex_lab.nn.celu_norm import CeluGroupNorm
from apex_lab.nn.rows import elu


def pair(channels: int, groups: int, dtype: torch.dtype) -> tuple[CeluGroupNorm, nn.GroupNorm]:
    torch.manual_seed(0)
    mine, theirs = CeluGroupNorm(groups, channels).to(dtype), nn.GroupNorm(groups, channels).to(dtype)
    with torch.no_grad():
        mine.weight.normal_()
        mine.bias.normal_()
    theirs.load_state_dict(mine.state_dict())
    return mine, theirs


def results(x: Tensor, norm: nn.GroupNorm, layout: torch.memory_format) -> list[Tensor]:
    """Normalised values, and gradients of input, weight and bias."""
    x = x.clone().requires_grad_()
    given = x.clone(memory_format=layout)
    y = norm(given) if isinstance(norm, CeluGroupNorm) else norm(F.celu(given))
    assert y.is_contiguous(memory_format=layout)
    (y * torch.arange(y.numel(), dtype=y.dtype).view(y.shape).sin()).sum().backward()
    assert x.grad is not None
    assert norm.weight.grad is not None
    assert norm.bias.grad is not None
    return [y.detach(), x.grad, norm.weight.grad, norm.bias.grad]


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
@pytest.mark.parametrize(("channels", "groups", "side"), [(8, 4, 5), (16, 4, 8), (32, 8, 3), (64, 8, 4), (32, 16, 1)])
def test_the_two_layers_one_by_one(channels: int, groups: int, side: int, layout: torch.memory_format) -> None:
    x = torch.randn(
        3, channels, side, side + (side > 1), dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    mine, theirs = pair(channels, groups, torch.float64)
    for found, wanted in zip(results(x, mine, layout), results(x, theirs, layout), strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
@pytest.mark.parametrize("shift", [0.0, 10.0, -10.0])
def test_single_precision_is_as_exact_as_of_the_two_layers(layout: torch.memory_format, shift: float) -> None:
    """Also where the mean is far larger than the spread, and where all values are near -1."""
    x = torch.randn(2, 16, 32, 32, generator=torch.Generator().manual_seed(1)) + shift
    mine, theirs = pair(16, 4, torch.float32)
    exact = results(x.double(), pair(16, 4, torch.float64)[1], layout)
    for found, plain, wanted in zip(results(x, mine, layout), results(x, theirs, layout), exact, strict=True):
        largest = wanted.abs().max()
        error, usual = ((part.double() - wanted).abs().max() / largest for part in (found, plain))
        assert error < 2 * usual + 1e-6


def test_elu() -> None:
    ends = torch.tensor([float("-inf"), -1e-8, -0.0, 0.0, float("inf")])
    x = torch.cat([torch.linspace(-30, 5, 100001), ends])
    exact = torch.where(x > 0, x.double(), torch.expm1(x.double().clamp_max(0)))
    finite = exact.isfinite()
    assert (elu(x).double() - exact)[finite].abs().max() < 1.2e-7
    assert torch.equal(elu(x)[~finite], x[~finite])
    assert elu(torch.tensor([float("nan")])).isnan().all()


def test_half_precision_and_no_images() -> None:
    mine, theirs = pair(16, 4, torch.float32)
    x = torch.randn(2, 16, 4, 4)
    with torch.autocast("cpu", torch.bfloat16):
        half = x.bfloat16()
        torch.testing.assert_close(mine(half.clone()), theirs(F.celu(half)))
    assert mine(x[:0]).shape == (0, 16, 4, 4)
