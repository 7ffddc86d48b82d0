"""One scenario from the goal image to the outcome."""

from __future__ import annotations

import os
from functools import lru_cache

import numpy as np

from sims.arrangement.cell import Cell
from sims.arrangement.controller import Controller
from sims.arrangement.judge import Judge
from sims.arrangement.planner import Planner
from sims.arrangement.progress import Progress
from sims.arrangement.scenario import Placement, Scenario
from sims.arrangement.scene import Scene, see
from sims.arrangement.settings import Settings
from sims.arrangement.studio import studio
from sims.arrangement.types import Frame, OnFrame, Outcome, Perceive
from sims.world import STEPS_PER_S


def run(scenario: Scenario, perceive: Perceive, settings: Settings, on_frame: OnFrame | None = None) -> Outcome:
    """Carry out a scenario.

    Args:
        perceive: image to detections; its exceptions are passed on.
        on_frame: called `settings.video_fps` times per simulated second. Costs an image each.

    Raises:
        ValueError: `perceive` returned a mask of another shape than its image.
    """
    cell, planner, camera = _cell(os.getpid()), _planner(os.getpid()), studio(settings)
    goal_names, goal_poses = _load(cell, scenario.goal)
    goal_view = camera.view(goal_names, goal_poses)
    goal = see(goal_view, perceive(goal_view), settings)
    names, start = _load(cell, scenario.current)
    judge = Judge(settings, scenario.current, start)
    notes = [""]

    def look() -> Scene:
        view = camera.view(names, cell.world.poses(), cell.world.joints())
        return see(view, perceive(view), settings)

    planner.begin(settings.planning_limit * len(names))
    controller = Controller(
        settings,
        cell,
        planner,
        goal,
        look,
        limit_s=settings.time_limit_s * len(names),
        watch=lambda attempt, begins: judge.watch(attempt, begins, cell.world.poses()),
        note=lambda phase: notes.__setitem__(0, phase),
    )

    def film(steps: int) -> None:
        if steps % max(1, STEPS_PER_S // settings.video_fps) == 0:
            assert on_frame is not None
            view = camera.view(names, cell.world.poses(), cell.world.joints())
            scene = controller.progress.scene
            seen = () if scene is None else scene.detections
            on_frame(
                Frame(cell.time_s, view, goal.view, seen, goal.detections, _numbers(controller.progress), notes[0])
            )

    if on_frame is not None:
        cell.on_step = film
    ended = controller.arrange()
    cell.on_step = None
    goals = dict(zip(goal_names, goal_poses, strict=True))
    return Outcome(
        task=scenario.task,
        index=scenario.index,
        objects=judge.objects(cell.world.poses(), goals, controller.progress, ended),
        subtasks=tuple(judge.subtask(attempt, goal) for attempt in controller.finished),
        time_s=cell.time_s,
        ended=ended,
    )


def _load(cell: Cell, placements: tuple[Placement, ...]) -> tuple[tuple[str, ...], np.ndarray]:
    """Names and poses (O, 7) of the objects at rest."""
    cell.load(placements)
    return tuple(placement.name for placement in placements), cell.world.poses()


def _numbers(progress: Progress) -> tuple[tuple[int, int], ...]:
    """The matches as indices of detections."""
    scene, goals = progress.scene, progress.goal.items
    return tuple((scene.items[item].number, goals[goal].number) for item, goal in progress.matches if scene is not None)


@lru_cache(maxsize=1)
def _cell(process: int) -> Cell:
    return Cell()


@lru_cache(maxsize=1)
def _planner(process: int) -> Planner:
    return Planner()
