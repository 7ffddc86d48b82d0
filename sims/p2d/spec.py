"""What a trajectory is going to be, as pure data drawn from (seed, split, index, attempt) alone."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sims.assets import ObjectModel
from sims.errors import SimError
from sims.p2d.settings import Settings

MARGIN_M = 0.015
"""Least distance between the footprints of two objects, and of an object and the gripper at its start."""
GRIPPER_M = (0.07, 0.21)
"""Footprint of the hand along and across its fingers' closing plane."""
MIN_LINE_M = 0.2
TRIES = 200


@dataclass(frozen=True)
class Placement:
    """One object: class index, name of its rest, centre on the table (metres), quaternion of its frame (x, y, z, w)."""

    class_index: int
    rest: str
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]


@dataclass(frozen=True)
class Spec:
    """One attempt at a trajectory.

    Attributes:
        objects: in slot order.
        start, end: of the fingertips' line on the table, metres.
        height_m: of the fingertips above the table.
        yaw_rad: of the gripper about the vertical.
        aimed: the line was drawn so that it meets an object.
    """

    split: str
    index: int
    attempt: int
    objects: tuple[Placement, ...]
    start: tuple[float, float]
    end: tuple[float, float]
    height_m: float
    yaw_rad: float
    aimed: bool


def generator(settings: Settings, split: str, index: int, attempt: int) -> np.random.Generator:
    """The stream of random numbers of one attempt; splits never share one."""
    name = int.from_bytes(hashlib.sha256(split.encode()).digest()[:8], "little")
    return np.random.default_rng(np.random.SeedSequence([settings.seed, name, index, attempt]))


def sample(settings: Settings, split: str, index: int, attempt: int = 0) -> Spec:
    """Draw one attempt at a trajectory.

    Raises:
        SimError: no arrangement fits into the workspace.
    """
    from sims.assets import object_models

    models = object_models(settings.objects, settings.objects_root)
    rng = generator(settings, split, index, attempt)
    for _ in range(TRIES):
        spec = _draw(settings, models, rng, split, index, attempt)
        if spec is not None:
            return spec
    raise SimError(
        f"No arrangement of {settings.max_objects} objects was found in workspace_x {settings.workspace_x}, workspace_y "
        f"{settings.workspace_y}: make the workspace larger or max_objects smaller."
    )


def _draw(
    settings: Settings, models: tuple[ObjectModel, ...], rng: np.random.Generator, split: str, index: int, attempt: int
) -> Spec | None:
    count = int(rng.integers(settings.min_objects, settings.max_objects + 1))
    classes = rng.choice(len(models), size=count, replace=False)
    low = np.array([settings.workspace_x[0], settings.workspace_y[0]])
    high = np.array([settings.workspace_x[1], settings.workspace_y[1]])
    placed: list[Placement] = []
    outlines: list[np.ndarray] = []
    for class_index in classes:
        for _ in range(20):
            placement, outline = _put(models[class_index], int(class_index), rng, low, high)
            if all(separate(outline, other, MARGIN_M) for other in outlines):
                placed.append(placement)
                outlines.append(outline)
                break
        else:
            return None
    aimed = bool(rng.random() < settings.aim)
    for _ in range(20):
        start, end = _line(rng, low, high, placed[int(rng.integers(count))] if aimed else None)
        yaw = float(rng.uniform(-np.pi / 3, np.pi / 3))
        hand = rectangle(start, GRIPPER_M, yaw)
        if np.linalg.norm(end - start) >= MIN_LINE_M and all(separate(hand, other, MARGIN_M) for other in outlines):
            return Spec(split, index, attempt, tuple(placed), _pair(start), _pair(end), settings.height_m, yaw, aimed)
    return None


def _pair(point: np.ndarray) -> tuple[float, float]:
    return float(point[0]), float(point[1])


def _put(
    model: ObjectModel, class_index: int, rng: np.random.Generator, low: np.ndarray, high: np.ndarray
) -> tuple[Placement, np.ndarray]:
    """A random rest, place and direction, and the rectangle around the object's outline on the table (4, 2)."""
    name, roll, pitch = model.rests[int(rng.integers(len(model.rests)))]
    yaw = float(rng.uniform(-np.pi, np.pi))
    centre = rng.uniform(low, high)
    turned = Rotation.from_euler("xy", [roll, pitch]).apply(model.vertices)
    quaternion = (Rotation.from_euler("z", yaw) * Rotation.from_euler("xy", [roll, pitch])).as_quat()
    outline = rectangle(centre, np.ptp(turned[:, :2], axis=0), yaw)
    position = (float(centre[0]), float(centre[1]), float(-turned[:, 2].min()) + 0.002)
    x, y, z, w = (float(value) for value in quaternion)
    return Placement(class_index, name, position, (x, y, z, w)), outline


def _line(
    rng: np.random.Generator, low: np.ndarray, high: np.ndarray, target: Placement | None
) -> tuple[np.ndarray, np.ndarray]:
    """Start and end (2,) of a line in the workspace, through the target's centre where there is one."""
    start = rng.uniform(low, high)
    if target is None:
        return start, rng.uniform(low, high)
    through = np.array(target.position[:2])
    reach = rng.uniform(0.05, 0.2)
    direction = (through - start) / max(float(np.linalg.norm(through - start)), 1e-9)
    return start, np.clip(through + reach * direction, low, high)


def rectangle(centre: np.ndarray, sides: tuple[float, float] | np.ndarray, yaw: float) -> np.ndarray:
    """(4, 2) corners of a turned rectangle, in order."""
    half = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * np.asarray(sides) / 2
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return half @ np.array([[cosine, sine], [-sine, cosine]]) + centre


def separate(one: np.ndarray, other: np.ndarray, margin: float) -> bool:
    """Whether two convex polygons (N, 2) lie at least `margin` apart along one of their edges' normals."""
    for polygon in (one, other):
        edges = np.roll(polygon, -1, axis=0) - polygon
        normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        a, b = one @ normals.T, other @ normals.T
        gap = np.maximum(b.min(axis=0) - a.max(axis=0), a.min(axis=0) - b.max(axis=0))
        if gap.max() >= margin:
            return True
    return False
