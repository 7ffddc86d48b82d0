"""What z_bg may do to the background's picture, and cast shadows."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from apex_lab.models.apex import Background
from apex_lab.models.apex.background import shadowed


def background(change: str, **more: object) -> Background:
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


def lit_and_seen() -> tuple[Tensor, Tensor]:
    """A background and an image with darker, brighter and other pixels, (2, 3, 4, 5) each."""
    g = torch.Generator().manual_seed(2)
    backdrop = 0.1 + 0.8 * torch.rand(2, 3, 4, 5, dtype=torch.float64, generator=g)
    share = 0.3 + 0.9 * torch.rand(2, 1, 4, 5, dtype=torch.float64, generator=g)
    return backdrop, share * backdrop + 0.1 * torch.rand(2, 3, 4, 5, dtype=torch.float64, generator=g)


def test_a_shadow_is_the_darker_colour_that_is_nearest() -> None:
    backdrop, image = lit_and_seen()
    found = shadowed(backdrop, image, 0.6)
    darkest = lit = 0
    for n in range(2):
        for y in range(4):
            for x in range(5):
                b, seen = backdrop[n, :, y, x].tolist(), image[n, :, y, x].tolist()
                u = sum(p * q for p, q in zip(b, seen, strict=True)) / sum(p * p for p in b)
                darkest, lit = darkest + (u < 0.6), lit + (u > 1)
                want = [min(max(u, 0.6), 1.0) * p for p in b]
                assert found[n, :, y, x].tolist() == pytest.approx(want, rel=1e-12)
                others = [sum((q - 0.01 * i * p) ** 2 for p, q in zip(b, seen, strict=True)) for i in range(60, 101)]
                nearest = sum((p - q) ** 2 for p, q in zip(want, seen, strict=True))
                assert nearest <= min(others) + 1e-12
                if u > 1:  # brighter than the background: no shadow
                    assert torch.equal(found[n, :, y, x], backdrop[n, :, y, x])
    assert darkest > 2
    assert lit > 2
    assert darkest + lit < 38


def test_no_gradient_goes_through_how_dark_a_shadow_is() -> None:
    backdrop, image = (x.requires_grad_() for x in lit_and_seen())
    found = shadowed(backdrop, image, 0.6)
    weights = torch.rand(found.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    to_backdrop, to_image = torch.autograd.grad((weights * found).sum(), [backdrop, image], allow_unused=True)
    assert to_image is None
    torch.testing.assert_close(to_backdrop, weights * (found / backdrop).detach())


def test_black_has_no_shadow() -> None:
    black = torch.zeros(1, 3, 4, 4)
    assert torch.equal(shadowed(black, torch.rand(1, 3, 4, 4), 0.6), black)


def test_a_background_is_seen_as_decoded_and_with_shadows_if_it_may_have_any() -> None:
    backdrop, image = lit_and_seen()
    plain, dark = background("colour"), background("colour", shadow=0.6)
    assert plain.cast(backdrop, image) is backdrop
    assert torch.equal(plain.seen(backdrop, image), backdrop[:, None])
    cast = shadowed(backdrop, image, 0.6)
    assert torch.equal(dark.cast(backdrop, image), cast)
    half = dark.cast(backdrop, image, torch.tensor(0.5, dtype=torch.float64))
    torch.testing.assert_close(half, shadowed(backdrop, image, 0.8))
    assert torch.equal(dark.seen(backdrop, image), torch.stack([backdrop, cast], 1))
