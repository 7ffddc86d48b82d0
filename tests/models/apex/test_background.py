"""What z_bg may do to the background's picture."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from apex_lab.models.apex import Background


def background(change: str, **more: str) -> Background:
    torch.manual_seed(0)
    built = Background(32, latent=4, width=8, change=change, **more)  # type: ignore[arg-type]
    built.initialise(0.1 + 0.8 * torch.rand(3, 32, 32))
    return built.double()


def codes() -> Tensor:
    return 5 * torch.randn(7, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def test_a_shade_moves_the_logits_of_all_channels_by_one_amount_with_a_bound_above() -> None:
    model = background("shade")
    with torch.no_grad():
        model.decoder.head[0].weight.mul_(200.0)
        logits = torch.logit(model.decode(codes()))
        raw = model.decoder(codes())
    moved = logits - model.bias_image.detach()
    torch.testing.assert_close(moved, moved[:, :1].expand_as(moved), rtol=1e-8, atol=1e-8)
    # written out: log 2 - log(1 + exp(-raw)) = log of twice the logistic function
    torch.testing.assert_close(moved[:, :1], torch.log(2 / (1 + torch.exp(-raw))), rtol=1e-8, atol=1e-8)
    assert moved.max() < math.log(2)
    assert moved.max() > 0.5
    assert moved.min() < -2


def test_a_shade_starts_at_the_median() -> None:
    model = background("shade")
    with torch.no_grad():
        for parameter in model.decoder.head.parameters():
            parameter.zero_()
        picture = model.decode(codes())
    torch.testing.assert_close(picture, torch.sigmoid(model.bias_image.detach()).expand_as(picture))


def test_a_colour_change_moves_channels_by_themselves() -> None:
    model = background("colour")
    with torch.no_grad():
        model.decoder.head[0].weight.mul_(200.0)
        moved = torch.logit(model.decode(codes())) - model.bias_image.detach()
    assert (moved - moved.mean(1, keepdim=True)).abs().max() > 0.5
    assert moved.max() > math.log(2)


def test_every_weight_of_a_shade_gets_a_gradient() -> None:
    model = background("shade")
    model.decode(codes()).square().sum().backward()
    for name, weight in model.named_parameters():
        if name.startswith(("decoder", "bias_image")):
            assert weight.grad is not None, name
            assert weight.grad.abs().max() > 0, name


def test_a_shade_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="needs a bias image"):
        background("shade", bias_image="none")
