"""The whole model against a second implementation of the paper: lists, loops, float64 (naive.py)."""

from __future__ import annotations

import itertools

import pytest
import torch

from apex_lab.models.apex import Apex, ApexEncoder, Background, FeatureGlimpses
from apex_lab.scene import Context, schedule_at
from tests.models.apex import naive
from tests.models.apex.small import SCHEDULE, SIZE, lively, video

P0 = float(SCHEDULE["discovery_presence"])
SCALES = (1.25, 0.75)  # of sigma_fg and sigma_bg


def check(model: Apex, x: torch.Tensor) -> list[naive.Told]:
    """Compares everything that the two say; returns what the slow one told."""
    with torch.no_grad():
        scene = model(
            x,
            Context({**SCHEDULE, **schedule_at(dict(zip(("sigma_fg_scale", "sigma_bg_scale"), SCALES, strict=True)))}),
        )
    told = [naive.explain(model, one, P0, SCALES) for one in x]
    for b, want in enumerate(told):
        assert scene.ids[b, :, :-1].tolist() == want.slots
        for name in naive.TERMS:
            assert float(scene.terms[name][b]) == pytest.approx(want.terms[name], rel=1e-8), name
        for t, masks in enumerate(want.masks):
            torch.testing.assert_close(scene.reconstruction[b, t], want.pictures[t], rtol=0, atol=1e-8)
            for slot, identity in enumerate(want.slots[t]):
                if identity != -1:
                    torch.testing.assert_close(scene.masks[b, t, slot], masks[identity], rtol=0, atol=1e-8)
    return told


@pytest.mark.parametrize(("slots", "render_top"), [(3, 4), (8, 3), (3, None)])
def test_masks_identities_and_every_term_of_the_objective(slots: int, render_top: int | None) -> None:
    model = lively(max_objects=slots, render_top=render_top).double().eval()
    told = check(model, video(2, 5).double())
    for one in told:
        frames = [set(held) - {-1} for held in one.slots]
        pairs = list(itertools.pairwise(frames))
        assert any(before & after for before, after in pairs)  # some stay
        assert any(before - after for before, after in pairs)  # some vanish
        assert any(after - before for before, after in pairs)  # some come later
        assert 0.0 < min(one.contexts) < 0.5  # some cells are explained already
        assert max(one.contexts) > 0.9


def test_without_the_shortcuts_of_encoder_and_glimpses() -> None:
    encoder = ApexEncoder(8, (4, 4, 6, 8, 8, 8), (1, 1, 1, 1), shortcuts=False)
    model = lively(encoder=encoder, glimpses=FeatureGlimpses(4, 6, shortcut=False)).double().eval()
    check(model, video(2, 4).double())


@pytest.mark.parametrize("shadow", [1.0, 0.7])
def test_with_a_background_that_is_a_shade(shadow: float) -> None:
    torch.manual_seed(7)
    background = Background(SIZE, 6, 6, change="shade", shadow=shadow)
    background.initialise(0.2 + 0.6 * torch.rand(3, SIZE, SIZE))
    check(lively(background=background).double().eval(), video(2, 4).double())
