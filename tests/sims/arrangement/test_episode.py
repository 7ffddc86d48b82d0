"""Whole episodes: the oracle arranges; broken input ends in a stated outcome."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable

import numpy as np
import pytest

pytest.importorskip("pybullet")

from sims.arrangement import episode, oracle
from sims.arrangement.cell import FINGERS
from sims.arrangement.scenario import Scenario, draw
from sims.arrangement.settings import Settings
from sims.arrangement.types import Detection, Frame, Outcome, Perceive, View
from sims.world import World

SETTINGS = Settings()


def _world() -> World:
    return episode._cell(os.getpid()).world


def _run(perceive: Perceive, task: int = 2, index: int = 0, settings: Settings = SETTINGS) -> Outcome:
    outcome = episode.run(draw(0, task, index, settings), perceive, settings)
    assert json.loads(json.dumps(dataclasses.asdict(outcome)))["ended"] == outcome.ended
    assert all((each.reason is None) == (each.distance_m <= settings.failed_m) for each in outcome.objects)
    assert all(each.attempts <= settings.max_attempts for each in outcome.subtasks)
    return outcome


def _then(change: Callable[[list[Detection]], list[Detection]], first: int = 0) -> Perceive:
    """The oracle, its detections changed from the `first`-th image on (0 is the goal image)."""
    calls = [0]

    def perceive(view: View) -> list[Detection]:
        found = oracle.perceive(view)
        calls[0] += 1
        return change(found) if calls[0] > first else found

    return perceive


def _reasons(outcome: Outcome) -> list[str | None]:
    return [each.reason for each in outcome.objects]


def test_the_oracle_arranges_two_objects_and_a_film_changes_nothing() -> None:
    outcome = _run(oracle.perceive)
    assert outcome.ended == "arranged"
    assert max(each.distance_m for each in outcome.objects) < 0.01
    assert all(each.attempts == 1 and each.failure is None for each in outcome.subtasks)
    frames: list[Frame] = []
    settings = Settings(video_fps=1)
    assert episode.run(draw(0, 2, 0, settings), oracle.perceive, settings, frames.append) == outcome
    assert len(frames) == int(outcome.time_s)
    assert len(frames[-1].matches) == 2
    assert any(frame.note.endswith("carry") for frame in frames)
    shown = [frame.view.truth for frame in frames]
    assert any(truth is not None and (truth.segmentation == 1).any() for truth in shown)


@pytest.mark.slow
@pytest.mark.parametrize("task", [3, 4])
def test_the_oracle_arranges_more(task: int) -> None:
    for index in range(3):
        outcome = _run(oracle.perceive, task, index)
        assert outcome.ended == "arranged"
        assert max(each.distance_m for each in outcome.objects) < 0.02


@pytest.mark.slow
def test_the_oracle_arranges_the_other_graspable_classes() -> None:
    settings = Settings(objects=("pudding_box", "banana"))
    outcome = _run(oracle.perceive, settings=settings)
    assert outcome.ended == "arranged"
    assert max(each.distance_m for each in outcome.objects) < 0.02


def test_no_detection() -> None:
    for first in (0, 1):  # none at all; none in the current image
        outcome = _run(_then(lambda _: [], first))
        assert (outcome.ended, outcome.subtasks, outcome.time_s) == ("nothing detected", (), 0.0)
        assert _reasons(outcome) == ["missed detection"] * 2


@pytest.mark.slow
def test_one_object_is_never_detected() -> None:
    """The other is arranged all the same, around it."""
    outcome = _run(_then(lambda found: found[1:]), 2, 1)
    assert outcome.objects[0].reason == "missed detection"
    assert outcome.objects[1].distance_m < 0.02 or outcome.ended == "stuck"


def test_objects_that_stand_on_each_other_s_targets() -> None:
    """One goes to the edge, the other home, then the first one home."""
    goal = draw(0, 2, 0, SETTINGS).goal
    places = [each.position[:2] for each in reversed(goal)]
    current = tuple(
        dataclasses.replace(each, position=(*place, each.position[2])) for each, place in zip(goal, places, strict=True)
    )
    outcome = episode.run(Scenario(0, 2, 0, goal, current), oracle.perceive, SETTINGS)
    assert outcome.ended == "arranged"
    assert max(each.distance_m for each in outcome.objects) < 0.02
    assert [each.kind for each in outcome.subtasks] == ["aside", "home", "home"]
    first, second, third = [each.object for each in outcome.subtasks]
    assert first == third != second


@pytest.mark.parametrize("first", [0, 1])
def test_a_mask_over_two_objects(first: int) -> None:
    """In the goal image too; in the current images alone."""

    def joined(found: list[Detection]) -> list[Detection]:
        return [dataclasses.replace(found[0], mask=np.any([each.mask for each in found], axis=0))]

    outcome = _run(_then(joined, first))
    assert "missed detection" in _reasons(outcome)


def test_wrong_appearances_are_a_wrong_match() -> None:
    def swapped(found: list[Detection]) -> list[Detection]:
        order = [each.appearance for each in reversed(found)]
        return [dataclasses.replace(each, appearance=word) for each, word in zip(found, order, strict=True)]

    outcome = _run(_then(swapped, 1))
    assert _reasons(outcome) == ["wrong match"] * 2


@pytest.mark.slow
def test_masks_over_everything_and_appearances_without_numbers() -> None:
    def broken(found: list[Detection]) -> list[Detection]:
        everything = np.ones_like(found[0].mask)
        nothing = np.zeros_like(everything)
        word = np.full_like(found[0].appearance, np.nan)
        return [Detection(everything, 1.0, word), Detection(nothing, np.nan, word), Detection(everything, 0.5, word)]

    outcome = _run(_then(broken))
    assert set(_reasons(outcome)) <= {None, "missed detection", "wrong match", "misplaced"}


def test_a_mask_of_another_shape_is_an_error_of_perception() -> None:
    with pytest.raises(ValueError, match=r"shape \(3, 3\)"):
        _run(lambda view: [Detection(np.ones((3, 3), bool), 1.0, np.zeros(2))])


def test_more_objects_in_the_goal_than_on_the_table() -> None:
    whole = draw(0, 3, 0, SETTINGS)
    scenario = Scenario(0, 3, 0, whole.goal, whole.current[1:2])
    outcome = episode.run(scenario, oracle.perceive, SETTINGS)
    assert [each.name for each in outcome.objects] == [whole.current[1].name]
    assert outcome.ended == "arranged"
    assert outcome.objects[0].distance_m < 0.02


def test_more_objects_on_the_table_than_in_the_goal() -> None:
    whole = draw(0, 3, 0, SETTINGS)
    scenario = Scenario(0, 3, 0, whole.goal[1:2], whole.current)
    outcome = episode.run(scenario, oracle.perceive, SETTINGS)
    assert [each.name for each in outcome.objects] == [whole.goal[1].name]
    assert outcome.ended == "arranged"
    assert outcome.objects[0].distance_m < 0.02


def test_an_object_moved_by_someone_else_is_brought_home() -> None:
    """It is moved just after the image was taken on which the next sub-task is planned."""
    scenario = draw(0, 2, 0, SETTINGS)
    known = np.array([each.position[:2] for each in (*scenario.goal, *scenario.current)])
    grid = np.array([(x, y) for x in np.linspace(0.36, 0.6, 9) for y in np.linspace(-0.19, 0.19, 9)])
    free = grid[np.argmax(np.linalg.norm(grid[:, None] - known, axis=-1).min(axis=1))]
    calls, moved = [0], [False]

    def perceive(view: View) -> list[Detection]:
        calls[0] += 1
        if calls[0] == 3:  # after the first sub-task
            pose = _world().poses()[0]
            place = [*free.tolist(), float(pose[2]) + 0.001]
            _world().bullet.call("resetBasePositionAndOrientation", _world().objects[0], place, pose[3:].tolist())
            moved[0] = True
        return oracle.perceive(view)

    outcome = episode.run(scenario, perceive, SETTINGS)
    assert moved[0]
    assert outcome.ended == "arranged"
    assert max(each.distance_m for each in outcome.objects) < 0.02


@pytest.mark.slow
def test_an_object_that_falls_off_the_table_costs_a_metre() -> None:
    calls = [0]

    def perceive(view: View) -> list[Detection]:
        calls[0] += 1
        if calls[0] == 2:
            _world().bullet.call("resetBasePositionAndOrientation", _world().objects[0], [0.5, -0.9, 0.1], [0, 0, 0, 1])
        return oracle.perceive(view)

    outcome = _run(perceive)
    assert (outcome.objects[0].distance_m, outcome.objects[0].reason) == (1.0, "fell")
    assert outcome.objects[1].distance_m < 0.02


@pytest.mark.slow
def test_a_slippery_gripper_fails_a_bounded_number_of_times() -> None:
    def perceive(view: View) -> list[Detection]:
        world = _world()
        for finger in FINGERS:
            if world.arm >= 0:
                world.bullet.call("changeDynamics", world.arm, finger, lateralFriction=0.0, spinningFriction=0.0)
        return oracle.perceive(view)

    outcome = _run(perceive, settings=Settings(max_attempts=2))
    assert outcome.ended == "stuck"
    assert max(each.attempts for each in outcome.subtasks) == 2
    assert {each.failure for each in outcome.subtasks} <= {"no grip", "lost"}
    assert "failed grasp" in _reasons(outcome)
    assert set(_reasons(outcome)) <= {"failed grasp", "fell"}  # fingers that slip off can tip an object over


@pytest.mark.slow
def test_time_is_up_after_the_sub_task_under_way() -> None:
    outcome = _run(oracle.perceive, settings=Settings(time_limit_s=0.5))
    assert outcome.ended == "out of time"
    assert len(outcome.subtasks) == 1
    assert "out of time" in _reasons(outcome)


def test_depth_with_noise_and_holes() -> None:
    outcome = _run(oracle.perceive, settings=Settings(depth="stereo"))
    assert max(each.distance_m for each in outcome.objects) < 0.05


@pytest.mark.slow
def test_an_outcome_does_not_depend_on_what_ran_before() -> None:
    one = _run(oracle.perceive, 2, 3)
    _run(oracle.perceive, 1, 4)
    assert _run(oracle.perceive, 2, 3) == one
