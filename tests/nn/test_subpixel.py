"""Sub-pixel convolutions against a convolution and a pixel shuffle."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from apex_lab.nn.subpixel import LARGE, SubPixelConv


@pytest.mark.parametrize("side", [1, 5, LARGE])
@pytest.mark.parametrize("factor", [2, 4])
def test_convolution_and_shuffle(side: int, factor: int) -> None:
    torch.manual_seed(0)
    layer = SubPixelConv(6, 5, factor).double()
    x = torch.randn(3, 6, side, side + (side > 1), dtype=torch.float64)
    weigh = torch.randn(3, 5, factor * side, factor * x.shape[3], dtype=torch.float64)
    results = []
    for draw in (layer, lambda x: F.pixel_shuffle(F.conv2d(x, layer.weight, layer.bias), factor)):
        given = x.clone().requires_grad_()
        y = draw(given)
        results.append([y, *torch.autograd.grad((y * weigh).sum(), (given, layer.weight, layer.bias))])
    for found, wanted in zip(*results, strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-12, atol=1e-12)
    assert layer(x).is_contiguous(memory_format=torch.channels_last)
