"""What the networks say before they have learned anything; and that `lively` does not depend on it."""

from __future__ import annotations

import math

import pytest
import torch

from apex_lab.models.apex import Apex
from tests.models.apex import small
from tests.models.apex.small import follow, lively, propose, tiny

NARROW = math.log(1 + math.exp(-3)) + 1e-3
"""0.0496: softplus of -3, and the least standard deviation; where z_where starts."""


def about(std: torch.Tensor, start: float, within: float) -> None:
    """The mean of some standard deviations, and each of them up to a factor."""
    assert float(std.mean()) == pytest.approx(start, rel=0.15)
    assert std.min() > start / within
    assert std.max() < start * within


@pytest.mark.parametrize("start", [0.05, 0.3, 1.5])
def test_standard_deviations_of_discovery_start_where_they_should(start: float) -> None:
    found = propose(tiny(start_std=start))
    about(found.q_what.std, start, within=2.5)
    about(found.q_where.std, NARROW, within=1.2)


@pytest.mark.parametrize("start", [0.05, 0.3])
def test_standard_deviations_of_propagation_start_where_they_should_as_does_the_prior_of_windows(start: float) -> None:
    steps = follow(tiny(start_std=start))
    alive, beliefs = steps.alive, steps.propagated
    assert alive.sum() > 4
    about(beliefs.q_what.std[alive], start, within=2.5)
    about(beliefs.q_where.std[alive], NARROW, within=1.2)
    about(beliefs.p_where.std[alive], NARROW, within=1.2)


def test_windows_of_propagated_objects_start_still() -> None:
    steps = follow(tiny())
    for belief in (steps.propagated.q_where, steps.propagated.p_where):
        assert belief.mean[steps.alive].abs().max() < 0.1


@pytest.mark.parametrize("start", [-2.0, 0.0, 3.0])
def test_masks_start_at_start_mask_with_a_small_spread(start: float) -> None:
    model = tiny(start_mask=start)
    what = torch.randn(500, 6, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        raw = model.mask_decoder(what)
        assert abs(float(raw.mean()) - start) < 0.1
        assert 0.01 < float(raw.std()) < 0.5  # but not all the same: masks can learn their shapes
        plain = tiny()
        torch.testing.assert_close(raw, plain.mask_decoder(what) + start, rtol=0, atol=1e-5)
        assert torch.equal(model.colour_decoder(what), plain.colour_decoder(what))
        logits = model.alpha(propose(model).what)
        assert abs(float(logits.mean()) - 5 * math.tanh(start)) < 0.5  # c = 5, Eq. 7


def test_lively_is_the_same_whatever_a_model_starts_as(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other tests need objects that stay, vanish and come; a change of how networks start must not take them away."""
    want = lively().state_dict()

    def other(**changes: object) -> Apex:
        model = tiny(start_presence=0.01, start_size=0.7, start_mask=4.0, **changes)
        with torch.no_grad():
            for p in model.parameters():
                p.normal_(std=3.0)
        return model

    monkeypatch.setattr(small, "tiny", other)
    got = small._lively.__wrapped__().state_dict()
    assert got.keys() == want.keys()
    for key, value in want.items():
        assert torch.equal(value, got[key]), key
