"""Image -> detections: by hand-made scenes, and from every model."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from apex_lab.arrangement.perception import ModelPerception, Oracle, Untrained, detections
from apex_lab.base.errors import UserError
from apex_lab.config.building import build_model, build_schedules
from apex_lab.inference.predictor import Predictor
from apex_lab.models.yardsticks import ColorClusters, OneSegment
from apex_lab.models.yardsticks import Oracle as Labels
from apex_lab.scene import Scene, SceneModel, schedule_at
from sims.arrangement.types import Truth, View
from sims.camera import Camera
from tests.conftest import compose_job

SIDE = 64
RED, GREEN = slice(8, 24), slice(36, 60)
"""Rows and columns of the two squares of `view`."""


def view(seed: int | None = None) -> View:
    """Two squares on grey, labelled 2 and 3; with a seed, noise."""
    rgb = np.full((SIDE, SIDE, 3), 120, dtype=np.uint8)
    rgb[RED, RED], rgb[GREEN, GREEN] = (200, 30, 30), (30, 200, 30)
    if seed is not None:
        rgb = np.random.default_rng(seed).integers(0, 256, rgb.shape, dtype=np.uint8)
    labels = np.zeros((SIDE, SIDE), dtype=np.uint8)
    labels[RED, RED], labels[GREEN, GREEN] = 2, 3
    return View(rgb, np.ones((SIDE, SIDE), dtype=np.float32), Camera(), Truth(labels, ("mug", "apple")))


def scene(masks: list[list[float]], presence: list[float], ids: list[int]) -> Scene:
    """A scene of one row of pixels; component 0 is the background."""
    count = len(masks)
    return Scene(
        masks=torch.tensor(masks)[None, None, :, None, :],
        background=torch.arange(count) == 0,
        ids=torch.tensor(ids)[None, None],
        presence=torch.tensor(presence)[None, None],
        appearance=10.0 * torch.arange(count, dtype=torch.float32)[None, None, :, None].expand(1, 1, count, 2),
        reconstruction=torch.zeros(1, 1, 3, 1, len(masks[0])),
        terms={},
    )


def test_what_is_absent_empty_or_background_is_no_detection() -> None:
    masks = [
        [0.5, 0.1, 0.1, 0.1],
        [0.2, 0.5, 0.1, 0.2],
        [0.2, 0.3, 0.6, 0.3],
        [0.0, 0.0, 0.1, 0.1],
        [0.1, 0.1, 0.1, 0.3],
    ]
    # 2 wins a pixel and is absent: the pixel goes to the next best, 1 or 0; 3 is present and wins none; 4 holds nothing
    found = detections(scene(masks, [1.0, 0.9, 0.4, 1.0, 1.0], [0, 7, 8, 9, -1]), 0.5)
    assert [one.mask[0].tolist() for one in found] == [[False, True, False, True]]
    assert (found[0].presence, found[0].appearance.tolist()) == (pytest.approx(0.9), [10.0, 10.0])
    found = detections(scene(masks, [1.0, 0.9, 0.4, 1.0, 1.0], [0, 7, 8, 9, -1]), 0.3)
    assert [one.mask[0].tolist() for one in found] == [[False, True, False, False], [False, False, True, True]]


def test_objects_without_numbers_are_absent() -> None:
    masks = [[0.3, 0.3, 0.3], [0.4, 0.1, 0.4], [float("nan"), 0.5, 0.1], [0.3, 0.1, 0.5]]
    found = detections(scene(masks, [1.0, 0.9, 1.0, float("nan")], [0, 7, 8, 9]), 0.0)
    assert [one.mask[0].tolist() for one in found] == [[True, False, True]]
    broken = [[float("nan")] * 3] * 4
    assert detections(scene(broken, [1.0] * 4, [0, 7, 8, 9]), 0.5) == []


def test_yardsticks_find_the_squares() -> None:
    clusters = Untrained(ColorClusters(colors=3)).ready(None, torch.device("cpu"))
    green, red = clusters(view())  # the larger one first
    assert (green.mask == (view().truth.segmentation == 3)).all()  # type: ignore[union-attr]
    assert (red.mask == (view().truth.segmentation == 2)).all()  # type: ignore[union-attr]
    assert red.appearance * 255 == pytest.approx([200, 30, 30], abs=0.5)
    labels = Untrained(Labels()).ready(None, torch.device("cpu"))
    assert [int(one.mask.sum()) for one in labels(view())] == [16 * 16, 24 * 24]
    assert Untrained(OneSegment()).ready(None, torch.device("cpu"))(view()) == []
    known = Oracle().ready(None, torch.device("cpu"))(view())
    assert [int(one.mask.sum()) for one in known] == [16 * 16, 24 * 24]
    assert [int(one.appearance.argmax()) for one in known] == [12, 8]  # places in the catalogue


def model_of(name: str) -> tuple[SceneModel, dict[str, Any]]:
    job = compose_job(f"model={name}", "data=sprites")
    torch.manual_seed(0)
    return build_model(job.config), schedule_at({n: float(s(6)) for n, s in build_schedules(job.config).items()})


@pytest.mark.parametrize("name", ["apex", "scalor", "gswm", "space"])
def test_every_model_with_a_background_perceives_an_image_of_any_size(name: str) -> None:
    model, schedule = model_of(name)
    assert model.input_size == (32, 32)
    perceive = ModelPerception(Predictor(model, schedule, torch.device("cpu"), seed=3), min_presence=0.0)
    one, other = view(1), view(2)
    found = perceive(one)
    assert all(each.mask.shape == (SIDE, SIDE) and each.mask.dtype == bool and each.mask.any() for each in found)
    assert sum(each.mask.astype(int) for each in found).max(initial=0) <= 1 if found else True  # type: ignore[union-attr]
    assert len({each.appearance.shape for each in found}) <= 1
    perceive(other)  # what was seen before changes nothing, whatever a model draws at random
    again = perceive(one)
    assert len(again) == len(found)
    for a, b in zip(found, again, strict=True):
        assert (a.mask == b.mask).all()
        assert (a.appearance == b.appearance).all()


@pytest.mark.parametrize("name", ["op3", "slot_attention"])
def test_models_without_a_background_are_refused(name: str) -> None:
    model, schedule = model_of(name)
    with pytest.raises(UserError, match="does not part objects from background, which the arrangement task needs"):
        ModelPerception(Predictor(model, schedule, torch.device("cpu")), 0.5)


def test_a_model_that_learns_needs_its_weights() -> None:
    model, _ = model_of("space")
    with pytest.raises(ValueError, match="Space learns: train it and give checkpoint="):
        Untrained(model)
