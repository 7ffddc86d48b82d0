"""Scenarios: the same objects in a goal layout and in a current layout, drawn from (seed, task, index) alone."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from sims.arrangement.grasps import hands
from sims.arrangement.settings import RESTS, Settings
from sims.assets import ObjectModel, object_models
from sims.errors import SimError
from sims.outlines import cover
from sims.rectangles import rectangle, separate

MARGIN_M = 0.03
"""Minimum distance between two objects' rectangles on the table."""
HAND_MARGIN_M = 0.008
VISIBLE = 0.7
"""Minimum visible share of every object's outline."""
CANDIDATES, RESTARTS = 40, 500
DROP_M = 0.0005


@dataclass(frozen=True)
class Placement:
    """One object: class name, position of its frame in metres, quaternion (x, y, z, w)."""

    name: str
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]

    @property
    def pose(self) -> np.ndarray:
        """(7,) position and quaternion."""
        return np.array([*self.position, *self.quaternion])


@dataclass(frozen=True)
class Scenario:
    """Goal and current layout of the same objects, in the same order."""

    seed: int
    task: int
    index: int
    goal: tuple[Placement, ...]
    current: tuple[Placement, ...]


@dataclass(frozen=True)
class _Shape:
    """A model in its resting orientation: convex outline's rectangle (long, narrow), and where its frame is."""

    model: ObjectModel
    resting: Rotation
    sides: np.ndarray
    lift_m: float


@dataclass(frozen=True)
class _Spot:
    placement: Placement
    outline: np.ndarray
    hands: tuple[np.ndarray, ...]
    points: np.ndarray


def draw(seed: int, task: int, index: int, settings: Settings) -> Scenario:
    """Scenario `index` of the task with `task` objects.

    Raises:
        SimError: the settings name fewer objects, or leave them no room.
    """
    if not 1 <= task <= len(settings.objects):
        raise SimError(f"a task of {task} objects needs as many names in objects, which has {len(settings.objects)}.")
    word = int.from_bytes(hashlib.sha256(b"arrangement scenario").digest()[:8], "little")
    rng = np.random.default_rng(np.random.SeedSequence([seed, word, task, index]))
    names = settings.objects[:task]
    goal = layout(settings, names, rng)
    return Scenario(seed, task, index, goal, layout(settings, names, rng, away_from=goal))


def layout(
    settings: Settings, names: tuple[str, ...], rng: np.random.Generator, away_from: tuple[Placement, ...] = ()
) -> tuple[Placement, ...]:
    """Random places of objects: in the workspace, visible, apart, and each with room for the gripper.

    Args:
        names: classes, each of `RESTS`.
        away_from: object i lies at least `settings.moved_m` from the i-th of these.

    Raises:
        SimError: no layout was found.
    """
    shapes = [_shape(name) for name in names]
    for _ in range(RESTARTS):
        spots = _placed(settings, shapes, rng, away_from)
        if spots is not None and not _hidden(settings, spots):
            return tuple(spot.placement for spot in spots)
    raise SimError(
        f"No layout of {', '.join(names)} was found in workspace_x {settings.workspace_x} and workspace_y "
        f"{settings.workspace_y}: make the workspace larger."
    )


def _placed(
    settings: Settings, shapes: list[_Shape], rng: np.random.Generator, away_from: tuple[Placement, ...]
) -> list[_Spot] | None:
    """Places objects one by one at the first of `CANDIDATES` random spots that fits; None if none does."""
    spots: list[_Spot] = []
    low, high = np.transpose([settings.workspace_x, settings.workspace_y])
    for number, shape in enumerate(shapes):
        centres = rng.uniform(low, high, size=(CANDIDATES, 2))
        yaws = rng.uniform(-np.pi, np.pi, size=CANDIDATES)
        if away_from:
            far = np.linalg.norm(centres - away_from[number].position[:2], axis=1) >= settings.moved_m
            centres, yaws = centres[far], yaws[far]
        for centre, yaw in zip(centres, yaws.tolist(), strict=True):
            spot = _spot(shape, centre, yaw)
            if _fits(spot, spots):
                spots.append(spot)
                break
        else:
            return None
    return spots


def _fits(spot: _Spot, spots: list[_Spot]) -> bool:
    """Whether a further object leaves all rectangles apart, and the hand a free way down to each object."""
    if not all(separate(spot.outline, other.outline, MARGIN_M) for other in spots):
        return False
    together = [*spots, spot]
    return all(
        any(
            all(separate(hand, other.outline, HAND_MARGIN_M) for other in together if other is not one)
            for hand in one.hands
        )
        for one in together
    )


def _spot(shape: _Shape, centre: np.ndarray, yaw: float) -> _Spot:
    turned = Rotation.from_euler("z", yaw) * shape.resting
    position = np.array([*centre, shape.lift_m])
    long, narrow = float(shape.sides.max()), float(shape.sides.min())
    along = yaw + (0.0 if shape.sides[0] >= shape.sides[1] else np.pi / 2)
    place, quaternion = (tuple(float(value) for value in row) for row in (position, turned.as_quat()))
    return _Spot(
        Placement(shape.model.name, place, quaternion),  # type: ignore[arg-type]
        rectangle(centre, shape.sides, yaw),
        tuple(hands(centre, (long, narrow), along)),
        turned.apply(shape.model.vertices) + position,
    )


def _hidden(settings: Settings, spots: list[_Spot]) -> bool:
    """Whether an object is cut off by the image, or others hide more than 1 - `VISIBLE` of its outline."""
    size = 64
    camera = settings.camera
    taken = np.zeros((size, size), dtype=bool)
    for spot in sorted(spots, key=lambda each: camera.project(each.points, 1)[1].mean()):
        pixels, _ = camera.project(spot.points, size)
        if pixels.min() < 0 or pixels.max() > size:
            return True
        reach, _ = cover(camera, size, spot.points)
        if np.count_nonzero(reach & ~taken) < VISIBLE * np.count_nonzero(reach):
            return True
        taken |= reach
    return False


@lru_cache(maxsize=32)
def _shape(name: str) -> _Shape:
    (model,) = object_models((name,))
    resting = Rotation.from_quat(dict(model.rests)[RESTS[name]])
    points = resting.apply(model.touching)
    return _Shape(model, resting, np.ptp(points[:, :2], axis=0), DROP_M - float(points[:, 2].min()))
