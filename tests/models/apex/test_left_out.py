"""On a CPU, frames and components that hold nothing are left out: the numbers are those of a pass over all."""

from __future__ import annotations

import contextlib

import pytest
import torch
from torch import Tensor

from apex_lab.models.apex import Background
from apex_lab.nn.noise import RankNoise
from apex_lab.scene import Context, Scene, schedule_at
from tests.models.apex.small import SCHEDULE, everything, lively, video

IMAGES = {"carry": 0.0, "discover": 1.0}  # no object is ever carried on
LEFT_ALONE = {"carry": 1.0, "discover": 0.0}  # carried videos never discover


def passed(
    changed: dict[str, float], all_of_it: bool, chunks: int = 1, **parts: object
) -> tuple[list[Scene], dict[str, Tensor | None]]:
    """Scenes of a pass in training, and the gradients of the sum of all terms, the one noise after the other."""
    model = lively(**parts).double().train()
    schedule = {**SCHEDULE, **schedule_at(changed)}
    torch.manual_seed(3)
    scenes: list[Scene] = []
    with everything() if all_of_it else contextlib.nullcontext():
        for part in video(3, 6).double().chunk(chunks, dim=1):
            state = scenes[-1].state if scenes else None
            scenes.append(model(part, Context(schedule, RankNoise(3, 0, 3), state, detail=True)))
    torch.stack([term.sum() for scene in scenes for term in scene.terms.values()]).sum().backward()
    return scenes, {name: weight.grad for name, weight in model.named_parameters()}


SOME = {"carry": 0.6, "discover": 0.3}
MERGES = {"merges": 2, "background": Background(32, 6, 6, shadow=0.7)}


@pytest.mark.parametrize("chunks", [1, 3])
@pytest.mark.parametrize(
    ("changed", "parts"),
    [({}, {}), (IMAGES, {}), (LEFT_ALONE, {}), (SOME, {}), (SOME, MERGES)],
    ids=["videos", "images", "alone", "some", "merges and shadows"],
)
def test_what_holds_nothing_changes_no_number_and_no_gradient(
    changed: dict[str, float], parts: dict[str, object], chunks: int
) -> None:
    passes = [passed(changed, all_of_it, chunks, **parts) for all_of_it in (False, True)]
    (scenes, gradients), (expected, wanted) = passes
    for scene, other in zip(scenes, expected, strict=True):
        for name in ("masks", "presence", "appearance", "reconstruction"):
            torch.testing.assert_close(getattr(scene, name), getattr(other, name), rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(scene.windows, other.windows, rtol=1e-10, atol=1e-10, equal_nan=True)
        there = other.presence > 0
        assert scene.means is not None
        assert other.means is not None
        torch.testing.assert_close(scene.means[there], other.means[there], rtol=1e-10, atol=1e-10)
        assert torch.equal(scene.ids, other.ids)
        torch.testing.assert_close(scene.terms, other.terms, rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(scene.diagnostics, other.diagnostics, rtol=1e-10, atol=1e-10)
    for name, gradient in wanted.items():
        assert gradient is not None, name
        torch.testing.assert_close(gradients[name], gradient, rtol=1e-8, atol=1e-9, msg=name)


def test_a_term_that_nobody_reads_is_left_out() -> None:
    def terms(unused: frozenset[str]) -> dict[str, Tensor]:
        torch.manual_seed(3)
        return lively().double().train()(video(2, 3).double(), Context(SCHEDULE, unused=unused)).terms

    wanted = terms(frozenset())
    assert wanted.pop("loose_windows").sum() > 0
    torch.testing.assert_close(terms(frozenset({"loose_windows"})), wanted, rtol=0, atol=0)
