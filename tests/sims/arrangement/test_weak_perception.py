"""What weak models perceive, and bad depth cameras see, ends in a stated outcome after a bounded amount of work."""

from __future__ import annotations

import ast
import os
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

pytest.importorskip("pybullet")

import sims.arrangement
from sims.arrangement import episode, oracle, studio
from sims.arrangement.scenario import draw
from sims.arrangement.settings import Settings
from sims.arrangement.types import Detection, Ended, Outcome, Perceive, Reason, View

SETTINGS = Settings(planning_limit=1500, time_limit_s=4.0)
ONE_PIECE = 10_000
"""Comparisons that one piece of planning among dozens of bodies may go beyond the limit."""
ONE_SUBTASK_S = 40.0


def _run(perceive: Perceive, settings: Settings = SETTINGS) -> Outcome:
    outcome = episode.run(draw(0, 2, 0, settings), perceive, settings)
    assert outcome.ended in get_args(Ended)
    for each in outcome.objects:
        assert 0 <= each.distance_m <= 1
        assert (each.reason is None) == (each.distance_m <= settings.failed_m)
        assert each.reason is None or each.reason in get_args(Reason)
    assert outcome.time_s <= settings.time_limit_s * 2 + ONE_SUBTASK_S
    assert episode._planner(os.getpid()).compared <= settings.planning_limit * 2 + ONE_PIECE
    return outcome


def _tiles(side: int, appearance: Callable[[int], np.ndarray]) -> Perceive:
    """Squares that know nothing of objects."""

    def perceive(view: View) -> list[Detection]:
        size = view.depth.shape[0]
        row, column = np.mgrid[:size, :size] // side
        number = row * (size // side) + column
        return [Detection(number == one, 1.0, appearance(one)) for one in range(number.max() + 1)]

    return perceive


def _splinters(view: View) -> list[Detection]:
    """Every object in six parts that look alike."""
    found = []
    for whole in oracle.perceive(view):
        pixels = np.argwhere(whole.mask)
        for part in np.array_split(pixels, 6):
            mask = np.zeros_like(whole.mask)
            mask[tuple(part.T)] = True
            found.append(Detection(mask, 1.0, whole.appearance))
    return found


def _labelled(view: View, labels: np.ndarray) -> list[Detection]:
    return [Detection(labels == one, 0.6, np.eye(64)[one]) for one in range(labels.max() + 1)]


def _scattered(view: View) -> list[Detection]:
    """Pixels of forty masks spread over the whole image."""
    return _labelled(view, np.random.default_rng(0).integers(0, 40, view.depth.shape))


def _border(view: View) -> list[Detection]:
    labels = np.full(view.depth.shape, -1)
    labels[:9], labels[-9:], labels[9:-9, :9], labels[9:-9, -9:] = 0, 1, 2, 3
    return _labelled(view, labels)


def _specks(view: View) -> list[Detection]:
    labels = np.full(view.depth.shape, -1)
    labels[::16, ::16] = np.arange(64).reshape(8, 8)
    return _labelled(view, labels)


def _everything(view: View) -> list[Detection]:
    """One huge mask, thirty times."""
    return [Detection(np.ones(view.depth.shape, bool), 1.0, np.full(3, float(number))) for number in range(30)]


def _empty(view: View) -> list[Detection]:
    return [Detection(np.zeros(view.depth.shape, bool), np.nan, np.zeros(3))] * 5


@pytest.mark.parametrize(
    "perceive",
    [
        _tiles(16, lambda number: np.random.default_rng(number).normal(size=4)),
        _tiles(8, lambda number: np.full(4, np.nan)),
        _splinters,
        _scattered,
        _border,
        _everything,
    ],
    ids=["tiles", "tiles_without_numbers", "splinters", "scattered", "border", "everything"],
)
def test_wrong_masks_have_an_outcome_in_bounded_time(perceive: Perceive) -> None:
    _run(perceive)


@pytest.mark.parametrize("perceive", [_empty, _specks])
def test_masks_without_bodies_are_no_detections(perceive: Perceive) -> None:
    outcome = _run(perceive)
    assert (outcome.ended, outcome.subtasks) == ("nothing detected", ())
    assert [each.reason for each in outcome.objects] == ["missed detection"] * 2


@pytest.mark.parametrize("hole", [0.0, np.nan, np.inf, -1.0])
@pytest.mark.parametrize("first", [0, 1])
def test_depth_without_any_value(hole: float, first: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In all images; in all but the goal's."""
    images = [0]

    def camera(depth: np.ndarray) -> np.ndarray:
        images[0] += 1
        return np.full_like(depth, hole) if images[0] > first else depth

    monkeypatch.setattr(studio, "stereo", camera)
    outcome = _run(oracle.perceive, SETTINGS.model_copy(update={"depth": "stereo"}))
    assert (outcome.ended, outcome.subtasks, outcome.time_s) == ("nothing detected", (), 0.0)
    assert [each.reason for each in outcome.objects] == ["missed detection"] * 2


@pytest.mark.parametrize(
    "camera",
    [
        lambda depth: depth + np.random.default_rng(0).normal(0, 0.03, depth.shape).astype(np.float32),
        lambda depth: depth * 0.8,  # everything floats, nearer to the camera
        lambda depth: np.where(np.random.default_rng(0).random(depth.shape) < 0.7, 0, depth),
    ],
    ids=["noise", "scale", "holes"],
)
def test_bad_depth(camera: Callable[[np.ndarray], np.ndarray], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(studio, "stereo", camera)
    _run(oracle.perceive, SETTINGS.model_copy(update={"depth": "stereo"}))


def test_planning_is_bounded() -> None:
    outcome = _run(oracle.perceive, Settings(planning_limit=1))
    assert (outcome.ended, outcome.subtasks, outcome.time_s) == ("out of time", (), 0.0)
    assert [each.reason for each in outcome.objects] == ["out of time"] * 2


def test_the_controller_does_not_read_the_simulator_s_state() -> None:
    folder = Path(sims.arrangement.__path__[0])
    for name in ("controller", "progress", "room", "moves", "planner", "grasps", "matching", "scene", "cloud"):
        tree = ast.parse((folder / f"{name}.py").read_text())
        read = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        assert not read & {"truth", "world", "segmentation", "poses"}, name
