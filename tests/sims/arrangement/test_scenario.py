"""Scenarios: a function of their key, visible, apart, and with room for the hand."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pybullet")

from pydantic import ValidationError

from sims.arrangement.scenario import draw, layout
from sims.arrangement.settings import RESTS, Settings
from sims.assets import object_models
from sims.errors import SimError
from sims.poses import moved

SETTINGS = Settings()


def test_a_scenario_is_a_function_of_its_key() -> None:
    scenario = draw(0, 3, 5, SETTINGS)
    assert scenario == draw(0, 3, 5, SETTINGS)
    others = [draw(1, 3, 5, SETTINGS), draw(0, 3, 6, SETTINGS), draw(0, 2, 5, SETTINGS)]
    assert all(scenario.goal[0] != other.goal[0] for other in others)


@pytest.mark.parametrize("task", [2, 3, 4])
def test_objects_are_the_task_s_group_in_view_apart_and_elsewhere(task: int) -> None:
    for index in range(8):
        scenario = draw(0, task, index, SETTINGS)
        for placements in (scenario.goal, scenario.current):
            assert tuple(each.name for each in placements) == SETTINGS.objects[:task]
            clouds = []
            for each, model in zip(placements, object_models(SETTINGS.objects[:task]), strict=True):
                points = moved(model.vertices, each.pose)
                pixels, _ = SETTINGS.camera.project(points, SETTINGS.image_size)
                assert pixels.min() >= 0
                assert pixels.max() <= SETTINGS.image_size
                for value, span in zip(each.position, (SETTINGS.workspace_x, SETTINGS.workspace_y), strict=False):
                    assert span[0] <= value <= span[1]
                clouds.append(points[:, :2])
            for i, cloud in enumerate(clouds):
                assert all(np.linalg.norm(cloud[:, None] - other, axis=-1).min() > 0.025 for other in clouds[:i])
        for goal, current in zip(scenario.goal, scenario.current, strict=True):
            assert np.linalg.norm(np.subtract(goal.position, current.position)) >= SETTINGS.moved_m - 1e-9


def test_every_graspable_class_has_its_rest() -> None:
    for model in object_models(tuple(RESTS)):
        assert RESTS[model.name] in dict(model.rests)


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(SimError, match="task of 5 objects"):
        draw(0, 5, 0, SETTINGS)
    narrow = Settings(workspace_x=(0.4, 0.51), workspace_y=(-0.06, 0.06), moved_m=0.0)
    with pytest.raises(SimError, match="make the workspace larger"):
        layout(narrow, SETTINGS.objects, np.random.default_rng(0))
    for broken in (
        {"objects": ("mug",)},
        {"objects": ("foam_brick",) * 2},
        {"objects": ()},
        {"workspace_x": (0.5, 0.4)},
    ):
        with pytest.raises(ValidationError):
            Settings(**broken)  # type: ignore[arg-type]
