"""Masks of one pixel by hand: two kept objects and two proposals that are not kept."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from apex_lab.models.scalor.composition import Layers
from apex_lab.models.scalor.result import Frame, Shapes, frame_masks
from tests.models.scalor.small import clip, run, small


def shapes(alphas: list[float], presences: list[float]) -> Shapes:
    """Components that fill the image, at z_depth 0: importance is half of alpha times presence."""
    k = len(alphas)
    alpha = torch.tensor(alphas)[None, :, None, None].expand(1, k, 4, 4)
    window = torch.tensor([2.0, 2.0, 0.0, 0.0]).expand(1, k, 4)  # no border of a glimpse inside the image
    return Shapes(alpha, window, torch.tensor([presences]), torch.zeros(1, k))


class Fixed(Frame):
    """Kept objects and others, all present, with these alphas."""

    def __init__(self, kept: list[float], others: list[float]) -> None:
        self._kept, self._others = (shapes(alphas, [1.0] * len(alphas)) for alphas in (kept, others))

    def objects(self) -> Shapes:
        return self._kept

    def untracked(self) -> Shapes:
        return self._others


def masks_of(kept: list[float], others: list[float], **options: Any) -> list[float]:
    """Masks at a pixel, of components of these alphas; A is 0.8."""
    alphas, one = torch.tensor([*kept, *others]), torch.ones(1, 2, 2)
    layers = Layers(one * alphas.sum(), one * alphas.sum() / 2, one[:, None], one * alphas.square().sum() / 2)
    masks = frame_masks(Fixed(kept, others), layers, 0.8 * one, **options)
    torch.testing.assert_close(masks.sum(1), one)
    found: list[float] = masks[0, :, 0, 0].tolist()
    return found


@pytest.mark.parametrize(
    ("untracked", "total"),
    [
        # alpha_k kappa_k of all components, 0.5 (0.36 + 0.04 + 0.16 + 0.01), and (1 - A) times all importance
        ("background", 0.5 * 0.57 + 0.2 * 0.65),
        ("dropped", 0.5 * 0.4 + 0.2 * 0.65),  # of the kept ones alone
    ],
)
def test_shares_of_what_is_rendered(untracked: str, total: float) -> None:
    got = masks_of([0.6, 0.2], [0.4, 0.1], readout="rendering", untracked=untracked)
    objects = [0.5 * 0.36 / total, 0.5 * 0.04 / total]
    assert got == pytest.approx([*objects, 1 - sum(objects)], rel=1e-5)


@pytest.mark.parametrize(
    ("kept", "others", "untracked", "want"),
    [
        ([0.3, 0.2], [0.29, 0.29], "background", [1, 0, 0]),  # the largest counts, not their sum
        ([0.3, 0.2], [0.29, 0.31], "background", [0, 0, 1]),
        ([0.2, 0.3], [0.29, 0.31], "dropped", [0, 1, 0]),
        ([0.0, 0.0], [0.5, 0.0], "dropped", [0, 0, 1]),
    ],
)
def test_owner_in_the_overlay(kept: list[float], others: list[float], untracked: str, want: list[float]) -> None:
    assert masks_of(kept, others, readout="overlay", untracked=untracked) == want


def test_untracked_cells_are_those_without_a_slot() -> None:
    """Of every frame: presence of what is kept and of what is not adds up to that of all that is rendered."""
    model = small().eval()
    video = clip(2, 4)
    with torch.no_grad():
        features, _ = model.encoder(video, None)
        steps, _ = model.objects(
            video, features, None, None, {"temperature": torch.tensor(1.0), "slot_gradient": torch.tensor(1.0)}
        )
    for step in steps:
        frame = Frame(step)
        old = 0.0 if step.propagated is None else float(step.propagated.objects.presence.sum())
        shown = float(frame.presence.sum() + frame.untracked().presence.sum())
        assert shown == pytest.approx(old + float(step.found.sum()))


def test_dropped_objects_leave_no_share_to_the_background() -> None:
    """With samples there are such proposals; without their share, objects have larger masks, and the rest is equal."""
    scenes = []
    for untracked in ("background", "dropped"):
        with torch.no_grad():
            scenes.append(run(small(untracked=untracked).eval(), clip(2, 4)))
    first, second = scenes
    assert torch.equal(first.ids, second.ids)
    assert torch.equal(first.reconstruction, second.reconstruction)
    assert float((first.masks - second.masks)[:, :, :-1].max()) < 1e-5
    assert float((second.masks - first.masks).abs().max()) > 0.01
