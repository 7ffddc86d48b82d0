"""Gradients stay finite, and true, where latents are at their bounds."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from apex_lab.models.apex import Apex, ApexNormalisation, MixtureLikelihood, ScalorNormalisation
from apex_lab.models.apex.likelihood import Likelihood
from apex_lab.models.apex.masks import MaskNormalisation
from apex_lab.models.apex.objective import mask_entropy
from apex_lab.nn.spatial_transformer import Paster
from apex_lab.scene import Context, schedule_at
from tests.models.apex.small import SIZE, tiny, video

COLD = schedule_at(
    {
        "temperature": 0.3,
        "discovery_presence": 1e-3,
        "carry": 1.0,
        "discover": 0.5,
        "sigma_fg_scale": 1.0,
        "sigma_bg_scale": 1.0,
    }
)


def push(head: nn.Module, value: float) -> None:
    """Adds to the biases of a decoder's last convolution."""
    conv = head[0]  # type: ignore[index]
    assert isinstance(conv, nn.Conv2d)
    assert conv.bias is not None
    conv.bias.add_(value)


def finite(model: Apex, x: torch.Tensor) -> None:
    torch.manual_seed(0)
    terms = model.train()(x, Context(COLD)).terms
    assert all(value.isfinite().all() for value in terms.values())
    sum(terms.values()).sum().backward()  # type: ignore[union-attr]
    assert [n for n, p in model.named_parameters() if p.grad is not None and not p.grad.isfinite().all()] == []


@pytest.mark.parametrize("masks", [ApexNormalisation(), ScalorNormalisation()])
@pytest.mark.parametrize("mask", [-60.0, 60.0])
@pytest.mark.parametrize("size", [-30.0, 30.0])
def test_masks_colours_and_windows_at_their_bounds(mask: float, size: float, masks: MaskNormalisation) -> None:
    """Black and white frames, all cells present, masks empty or full, windows smallest or largest."""
    model = tiny(masks=masks, start_presence=0.99)
    with torch.no_grad():
        push(model.mask_decoder.head, mask)
        push(model.colour_decoder.head, -60.0)
        assert model.discovery.head_where.bias is not None
        model.discovery.head_where.bias[:2] = size
    x = video()
    x[:, 1], x[:, 2] = 0.0, 1.0
    finite(model, x)


@pytest.mark.parametrize("over", ["channel", "pixel"])
@pytest.mark.parametrize("stays", [-60.0, 60.0])
def test_objects_that_all_vanish_or_all_stay(stays: float, over: str) -> None:
    model = tiny(start_presence=0.99, likelihood=MixtureLikelihood(0.1, 0.04, over))  # type: ignore[arg-type]
    with torch.no_grad():
        model.propagation.head_pres[-1].bias.fill_(stays)
        model.propagation.prior_pres[-1].bias.fill_(-stays)
    finite(model, video())


def test_mask_normalisation_and_entropy_by_finite_differences() -> None:
    torch.manual_seed(1)
    masks = ApexNormalisation()
    size = 0.3 + 0.4 * torch.rand(1, 3, 2, dtype=torch.float64)
    windows = torch.cat([size, torch.rand(1, 3, 2, dtype=torch.float64) - 0.5], -1)
    raw, presence = torch.randn(1, 3, 5, 5, dtype=torch.float64), 0.1 + 0.9 * torch.rand(1, 3, dtype=torch.float64)
    valid = torch.tensor([[True, True, False]])

    def outputs(raw: torch.Tensor, presence: torch.Tensor, windows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        out = masks.compose(masks.logits(raw), presence * valid, valid, Paster(windows, 5, 7))
        return out.objects, out.background, out.log_background, mask_entropy(out)

    assert torch.autograd.gradcheck(outputs, [x.requires_grad_() for x in (raw, presence, windows)])


@pytest.mark.parametrize("likelihood", [MixtureLikelihood(0.3, 0.2), MixtureLikelihood(0.3, 0.2, "pixel")])
@pytest.mark.parametrize("masks", [ApexNormalisation(), ScalorNormalisation()])
def test_likelihood_through_masks_and_windows_by_finite_differences(
    masks: MaskNormalisation, likelihood: Likelihood
) -> None:
    """From latents to nats, with an absent component and with pixels that no window reaches."""
    torch.manual_seed(2)
    windows = torch.tensor([[[0.4, 0.5, -0.41, 0.33], [0.5, 0.3, 0.27, -0.18]]], dtype=torch.float64)
    raw, colours = torch.randn(1, 2, 5, 5, dtype=torch.float64), torch.rand(1, 2, 3, 5, 5, dtype=torch.float64)
    presence = torch.tensor([[0.7, 0.9]], dtype=torch.float64)
    image, back = (torch.rand(1, 3, 8, 8, dtype=torch.float64) for _ in range(2))
    valid = torch.ones(1, 2, dtype=torch.bool)

    def nats(raw: torch.Tensor, presence: torch.Tensor, windows: torch.Tensor, colours: torch.Tensor) -> torch.Tensor:
        paster = Paster(windows, 5, 8)
        out = masks.compose(masks.logits(raw), presence, valid, paster)
        return likelihood(image, out.log_objects, paster.each(colours), out.log_background, back[:, None])

    assert (masks.compose(masks.logits(raw), presence, valid, Paster(windows, 5, 8)).foreground == 0).any()
    assert torch.autograd.gradcheck(nats, [x.requires_grad_() for x in (raw, presence, windows, colours)])


def test_a_missing_object_leaves_no_trace_in_any_gradient() -> None:
    """A slot that holds nothing: the same loss and gradients whatever rubbish lies in it."""
    masks, likelihood = ApexNormalisation(), MixtureLikelihood()
    valid = torch.tensor([[True, False]])
    image, back = torch.rand(1, 3, SIZE, SIZE), torch.rand(1, 3, SIZE, SIZE)
    rubbish = [torch.zeros(8, 8), torch.full((8, 8), 1e3)]
    results = []
    for other in rubbish:
        raw = torch.stack([torch.linspace(-1, 1, 64).reshape(8, 8), other])[None].requires_grad_()
        windows = torch.tensor([[[0.5, 0.5, 0.1, 0.2], [0.02, 0.9, 1.0, -1.0]]])
        paster = Paster(windows, 8, SIZE)
        out = masks.compose(masks.logits(raw), torch.tensor([[0.8, 0.0]]), valid, paster)
        means = torch.rand(1, 2, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(1))
        loss = (
            likelihood(image, out.log_objects, means, out.log_background, back[:, None]).sum() + mask_entropy(out).sum()
        )
        (gradient,) = torch.autograd.grad(loss, raw)
        assert (gradient[0, 1] == 0).all()
        results.append((loss.detach(), gradient[0, 0]))
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])
