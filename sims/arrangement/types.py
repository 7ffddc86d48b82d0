"""What perception, controller and results exchange: the interface of the arrangement task.

Legend: H, W image size, D length of an appearance vector. World frame: metres, z up, robot base at the origin, table
top at z = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sims.camera import Camera

Reason = Literal[
    "missed detection",
    "wrong match",
    "failed grasp",
    "fell",
    "collided",
    "no path",
    "misplaced",
    "out of time",
]
"""Why an object is not at its goal, the first that applies in the order of `judge.reason`.

missed detection: no mask of the goal or of the current image covers the object.
wrong match: it was matched with another object's goal.
failed grasp: it was not held, or lost, in the last attempt.
fell: it lies off the table or has tipped over.
collided: it was moved while another object was being handled.
no path: no collision-free motion of the arm was found.
misplaced: put down away from its goal.
out of time: the episode's simulated time, or what the planner may compare, was spent.
"""

Ended = Literal["arranged", "nothing detected", "stuck", "out of time"]
"""How an episode ended: every object that has a match is at its goal; there is, or was left, no pair of a current and a
goal detection; no possible sub-task was left; simulated time, or what the planner may compare, was spent."""


@dataclass(frozen=True)
class Truth:
    """What the simulator knows about an image. Only `oracle.perceive` and the judge read it.

    Attributes:
        segmentation: (H, W) uint8: 0 background, 1 arm, 2 + i object i.
        classes: class name of each object i.
    """

    segmentation: np.ndarray
    classes: tuple[str, ...]


@dataclass(frozen=True)
class View:
    """One RGB-D image.

    Attributes:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32, metres along the optical axis; 0 or not finite where the sensor has no value.
        camera: pose and field of view; H = W.
        truth: the simulator's labels; None for an image from elsewhere.
    """

    rgb: np.ndarray
    depth: np.ndarray
    camera: Camera
    truth: Truth | None = None


@dataclass(frozen=True)
class Detection:
    """One foreground object found in a `View`.

    Attributes:
        mask: (H, W) bool.
        presence: in [0, 1]. The controller uses every detection it is given: perception drops the empty ones.
        appearance: (D,) float vector; compared by L2 distance.
    """

    mask: np.ndarray
    presence: float
    appearance: np.ndarray


Perceive = Callable[[View], list[Detection]]
"""Image to detections, called for the goal image once and for the current scene before every sub-task."""


@dataclass(frozen=True)
class SubTask:
    """One object moved to one place.

    Attributes:
        object: class name of the object that the gripper was sent to; None where no object stands.
        goal: index of the goal detection that it is matched with; None for an object without a goal.
        kind: "home": to its goal; "aside": to a free place at the edge.
        attempts: grasps tried; 1 = without retry.
        failure: of the last attempt; None if the object was found at the place afterwards.
        time_s: simulated seconds of all its attempts.
    """

    object: str | None
    goal: int | None
    kind: Literal["home", "aside"]
    attempts: int
    failure: str | None
    time_s: float


@dataclass(frozen=True)
class ObjectOutcome:
    """Result for one object.

    Attributes:
        name: class name.
        distance_m: horizontal distance of its final place from its goal; 1.0 if it is off the table.
        reason: None if the distance is at most `Settings.failed_m`.
    """

    name: str
    distance_m: float
    reason: Reason | None


@dataclass(frozen=True)
class Outcome:
    """Result of one scenario. It depends on settings, task, index and perception alone.

    Attributes:
        task: number of objects.
        index: of the scenario in its task.
        objects: in the order of the scenario.
        subtasks: in the order of execution.
        time_s: simulated seconds.
        ended: why the controller stopped.
    """

    task: int
    index: int
    objects: tuple[ObjectOutcome, ...]
    subtasks: tuple[SubTask, ...]
    time_s: float
    ended: Ended


@dataclass(frozen=True)
class Frame:
    """One frame for a video.

    Attributes:
        time_s: simulated seconds since the start.
        view: with the arm in it.
        goal: the goal image.
        detections: of the last image without the arm.
        goal_detections: of the goal image.
        matches: pairs (index into `detections`, index into `goal_detections`).
        note: the sub-task and its phase, for example "home 1: grasp".
    """

    time_s: float
    view: View
    goal: View
    detections: tuple[Detection, ...]
    goal_detections: tuple[Detection, ...]
    matches: tuple[tuple[int, int], ...]
    note: str


OnFrame = Callable[[Frame], Any]
