"""Distances and reasons of failure, from what really happened. The controller never asks it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sims.arrangement.progress import Attempt, Progress
from sims.arrangement.scenario import Placement
from sims.arrangement.scene import Scene
from sims.arrangement.settings import Settings
from sims.arrangement.types import Ended, ObjectOutcome, Reason, SubTask
from sims.background import TABLE_HIGH_M, TABLE_LOW_M
from sims.stage import FIRST_OBJECT_ID

OFF_M = 1.0
"""Distance of an object off the table."""
TIPPED_RAD = 0.6
SHOVED_M = 0.01
"""An object that moved this far while another was handled was collided with."""
HANDLED_M = 0.06
"""The object that an attempt handles is the nearest one, within this distance of the grasp."""
OVERLAP = 0.5
"""Intersection over union from which a mask shows an object."""


@dataclass
class _Log:
    """What happened to one object: the last failure of its own handling; whether others' handling moved it."""

    failure: str | None = None
    shoved: bool = False


class Judge:
    """Watches one episode.

    Args:
        placements: of the current scene.
        start: (O, 7) their poses at rest.
    """

    def __init__(self, settings: Settings, placements: tuple[Placement, ...], start: np.ndarray) -> None:
        self.settings = settings
        self.names = tuple(placement.name for placement in placements)
        self.start, self.before = start, start
        self.logs = [_Log() for _ in self.names]
        self.handled: dict[int, int | None] = {}
        """id of an attempt -> object."""

    def watch(self, attempt: Attempt, begins: bool, poses: np.ndarray) -> None:
        """Note an attempt's begin and end."""
        if begins:
            self.before = poses
            assert attempt.point is not None
            distance = np.linalg.norm(poses[:, :2] - attempt.point[:2], axis=1)
            near = int(np.argmin(distance))
            self.handled[id(attempt)] = near if distance[near] <= HANDLED_M else None
            return
        moved = np.linalg.norm(poses[:, :3] - self.before[:, :3], axis=1) > SHOVED_M
        for number, log in enumerate(self.logs):
            if number == self.handled[id(attempt)]:
                log.failure, log.shoved = attempt.failure, False
            elif moved[number]:
                log.shoved = True

    def subtask(self, attempt: Attempt, goal: Scene) -> SubTask:
        """The record of a finished sub-task."""
        number = self.handled.get(id(attempt))
        return SubTask(
            object=None if number is None else self.names[number],
            goal=None if attempt.goal is None else goal.items[attempt.goal].number,
            kind=attempt.kind,
            attempts=attempt.attempts,
            failure=attempt.failure,
            time_s=attempt.ended_s - attempt.started_s,
        )

    def objects(
        self, poses: np.ndarray, goals: dict[str, np.ndarray], progress: Progress, ended: Ended
    ) -> tuple[ObjectOutcome, ...]:
        """Outcomes of the objects that have a goal.

        Args:
            poses: (O, 7) final.
            goals: class name -> (7,) pose in the goal scene.
        """
        found = []
        for number, name in enumerate(self.names):
            if name not in goals:
                continue
            off = _off_table(poses[number])
            distance = OFF_M if off else float(np.linalg.norm(poses[number, :2] - goals[name][:2]))
            failed = distance > self.settings.failed_m
            why = self._reason(number, off or self._tipped(poses, number), progress, ended) if failed else None
            found.append(ObjectOutcome(name, distance, why))
        return tuple(found)

    def _tipped(self, poses: np.ndarray, number: int) -> bool:
        turn = Rotation.from_quat(poses[number, 3:]) * Rotation.from_quat(self.start[number, 3:]).inv()
        return bool(turn.apply([0.0, 0.0, 1.0])[2] < np.cos(TIPPED_RAD))

    def _reason(self, number: int, fell: bool, progress: Progress, ended: Ended) -> Reason:
        name, log = self.names[number], self.logs[number]
        goal, scene = progress.goal, progress.scene
        assert scene is not None
        goal_item = _showing(goal, name)
        item = _showing(scene, name)
        pairs = dict(progress.matches)
        if fell:
            return "fell"
        if goal_item is None or item is None:
            return "missed detection"
        if pairs.get(item) != goal_item:
            return "wrong match"
        if log.failure in ("no grip", "lost"):
            return "failed grasp"
        if log.shoved or log.failure == "blocked":
            return "collided"
        if ended == "out of time":
            return "out of time"
        return "no path" if log.failure is None else "misplaced"


def _off_table(pose: np.ndarray) -> bool:
    on = pose[2] >= 0 and (pose[:2] >= TABLE_LOW_M).all() and (pose[:2] <= TABLE_HIGH_M).all()
    return not on


def _showing(scene: Scene, name: str) -> int | None:
    """Index of the item whose mask shows an object; None if there is none."""
    truth = scene.view.truth
    if truth is None or name not in truth.classes:
        return None
    real = truth.segmentation == FIRST_OBJECT_ID + truth.classes.index(name)
    for number, item in enumerate(scene.items):
        mask = np.asarray(scene.detections[item.number].mask, dtype=bool)
        if np.count_nonzero(mask & real) > OVERLAP * np.count_nonzero(mask | real):
            return number
    return None
