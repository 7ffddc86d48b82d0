"""The specification of a trajectory, sampled from (seed, split, index, attempt) alone."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from sims.assets import ObjectModel, object_models
from sims.errors import SimError
from sims.outlines import cover
from sims.p2d.settings import CROWDED, Settings
from sims.rectangles import Rectangles, rectangle, separate

MARGIN_M = 0.015
"""Minimum distance between the footprints of two objects, and of an object and the gripper at its start."""
GRIPPER_M = (0.07, 0.21)
"""Footprint of the hand: along and across the fingers' closing plane."""
YAW_RAD = 0.6
"""Maximum yaw of the gripper."""
MIN_LINE_M = 0.2
LINE_MARGIN_M = 0.06
"""Lines may extend beyond the objects' workspace by this."""
RUN_UP_M = (0.12, 0.24)
RUN_ON_M = (0.06, 0.16)
"""Distance of an aimed line's start before, and of its end behind, the centre of its target."""
BORDER = 0.015
"""Minimum distance of an object from the image border, as a share of the image's side."""
SEEN = 0.4
"""Minimum visible share of every object in at least one frame."""
OUTLINE_PX = 64
DROP_M = 0.0005
TRIES = 20
CANDIDATES, CROWDED_TRIES = 48, 50
"""For `CROWDED` objects or more: places drawn at once for one object, and tries. Most sets of five
objects that fit do within 40; for the others, attempts with other classes cost less than further tries."""
SAME_CLASSES = 5


class NoRoom(SimError):
    """No placement of the objects and of a line for the arm was found."""


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
        aimed: the line was sampled to meet an object.
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


def generator(settings: Settings, split: str, index: int, attempt: int | None = None) -> np.random.Generator:
    """Random generator of one attempt, or (None) of the choices that all attempts share; unique per split and index."""
    name = int.from_bytes(hashlib.sha256(split.encode()).digest()[:8], "little")
    stream = 0 if attempt is None else attempt + 1
    return np.random.default_rng(np.random.SeedSequence([settings.seed, name, index, stream]))


def sample(settings: Settings, split: str, index: int, attempt: int = 0) -> Spec:
    """Sample one attempt at a trajectory.

    The number of objects, their classes and whether the line is aimed are the same for all attempts of a trajectory, so
    that redrawing does not bias their shares; positions, directions and the line are sampled again in every attempt,
    the classes after `SAME_CLASSES` attempts.

    Raises:
        NoRoom: no arrangement was found that fits into the workspace and the image.
    """
    models = object_models(settings.objects, settings.objects_root, settings.image_size)
    shared = generator(settings, split, index)
    count = int(shared.integers(settings.min_objects, settings.max_objects + 1))
    classes = [int(number) for number in shared.choice(len(models), size=count, replace=False)]
    aimed = bool(shared.random() < settings.aim)
    rng = generator(settings, split, index, attempt)
    if attempt >= SAME_CLASSES:
        classes = [int(number) for number in rng.choice(len(models), size=count, replace=False)]
    place, tries = (_place, TRIES) if count < CROWDED else (_place_crowded, CROWDED_TRIES)
    for _ in range(tries):
        objects = place(settings, models, classes, rng)
        line = None if objects is None else _line(settings, objects, aimed, rng)
        if objects is not None and line is not None:
            start, end, yaw = line
            placements = tuple(each.placement for each in objects)
            return Spec(split, index, attempt, placements, start, end, settings.height_m, yaw, aimed)
    names = ", ".join(models[number].name for number in classes)
    raise NoRoom(
        f"No arrangement of {names} with a line for the arm was found in workspace_x {settings.workspace_x}, "
        f"workspace_y {settings.workspace_y} and the camera's image: make the workspace larger, move the camera "
        f"back, or lower max_objects {settings.max_objects}."
    )


@dataclass(frozen=True)
class _Placed:
    placement: Placement
    outline: np.ndarray
    """(4, 2) rectangle around the object on the table, metres."""
    points: np.ndarray
    """(N, 3) its vertices in the world, metres."""


def _place(
    settings: Settings, models: tuple[ObjectModel, ...], classes: list[int], rng: np.random.Generator
) -> list[_Placed] | None:
    """Place the objects one by one, entirely inside the image and apart from each other."""
    placed: list[_Placed] = []
    for class_index in classes:
        for _ in range(30):
            candidate = _put(settings, models[class_index], class_index, rng)
            if candidate is not None and all(separate(candidate.outline, other.outline, MARGIN_M) for other in placed):
                placed.append(candidate)
                break
        else:
            return None
    return None if _some_hidden(settings, placed) else placed


def _some_hidden(settings: Settings, placed: list[_Placed]) -> bool:
    """Whether objects nearer to the camera leave less than `SEEN` of an object's outline visible."""
    nearest_first = sorted(placed, key=lambda each: settings.camera.project(each.points, 1)[1].mean())
    taken = np.zeros((OUTLINE_PX, OUTLINE_PX), dtype=bool)
    for each in nearest_first:
        reach, _ = cover(settings.camera, OUTLINE_PX, each.points)
        if np.count_nonzero(reach & ~taken) < SEEN * np.count_nonzero(reach):
            return True
        taken |= reach
    return False


def _place_crowded(
    settings: Settings, models: tuple[ObjectModel, ...], classes: list[int], rng: np.random.Generator
) -> list[_Placed] | None:
    """As `_place`, for many objects."""
    low, high = np.transpose([settings.workspace_x, settings.workspace_y])
    places: dict[int, tuple[int, np.ndarray, float]] = {}
    taken = Rectangles(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    for class_index in sorted(classes, key=lambda number: -max(rest.sides.prod() for rest in _rests(models[number]))):
        rests = _rests(models[class_index])
        chosen = rng.integers(len(rests), size=CANDIDATES)
        candidates = Rectangles(
            rng.uniform(low, high, size=(CANDIDATES, 2)),
            np.stack([rest.sides for rest in rests])[chosen],
            rng.uniform(-np.pi, np.pi, size=CANDIDATES),
        )
        for number in np.flatnonzero((candidates.gaps(taken) >= MARGIN_M).all(axis=1)):
            rest, centre, yaw = rests[chosen[number]], candidates.centres[number], float(candidates.yaws[number])
            if _in_picture(settings, rest.at(centre, yaw)):
                places[class_index] = rest.number, centre, yaw
                taken = taken.joined(candidates[number : number + 1])
                break
        else:
            return None
    placed = [_put_at(settings, models[class_index], class_index, *places[class_index]) for class_index in classes]
    whole = [each for each in placed if each is not None]
    return None if len(whole) < len(placed) or _some_hidden(settings, whole) else whole


@dataclass(frozen=True)
class _Rest:
    """A model in its `number`-th resting orientation: vertices (N, 3) and the sides (2,) of the rectangle around it."""

    number: int
    vertices: np.ndarray
    sides: np.ndarray

    def at(self, centre: np.ndarray, yaw: float) -> np.ndarray:
        """(N, 3) its vertices at a place, in metres; those of `_put_at` but for rounding."""
        cosine, sine = np.cos(yaw), np.sin(yaw)
        flat = self.vertices[:, :2] @ np.array([[cosine, sine], [-sine, cosine]]) + centre
        return np.column_stack([flat, self.vertices[:, 2]])


@lru_cache(maxsize=64)
def _rests(model: ObjectModel) -> list[_Rest]:
    found = []
    for number, (_, turn) in enumerate(model.rests):
        resting = Rotation.from_quat(turn)
        vertices = resting.apply(model.vertices)
        vertices[:, 2] += DROP_M - resting.apply(model.touching)[:, 2].min()
        found.append(_Rest(number, vertices, np.ptp(vertices[:, :2], axis=0)))
    return found


def _put(settings: Settings, model: ObjectModel, class_index: int, rng: np.random.Generator) -> _Placed | None:
    """A random rest, position and yaw; None if the image would cut the object off."""
    rest = int(rng.integers(len(model.rests)))
    yaw = float(rng.uniform(-np.pi, np.pi))
    (x_low, x_high), (y_low, y_high) = settings.workspace_x, settings.workspace_y
    centre = rng.uniform([x_low, y_low], [x_high, y_high])
    return _put_at(settings, model, class_index, rest, centre, yaw)


def _put_at(
    settings: Settings, model: ObjectModel, class_index: int, rest: int, centre: np.ndarray, yaw: float
) -> _Placed | None:
    """An object in a resting orientation at a place; None if the image would cut it off."""
    name, resting = model.rests[rest]
    orientation = Rotation.from_euler("z", yaw) * Rotation.from_quat(resting)
    lowest = float(Rotation.from_quat(resting).apply(model.touching)[:, 2].min())
    position = np.array([*centre, DROP_M - lowest])
    points = orientation.apply(model.vertices) + position
    if not _in_picture(settings, points):
        return None
    footprint = Rotation.from_quat(resting).apply(model.vertices)[:, :2]
    outline = rectangle(centre, np.ptp(footprint, axis=0), yaw)
    quaternion = tuple(float(value) for value in orientation.as_quat())
    place = tuple(float(value) for value in position)
    return _Placed(Placement(class_index, name, place, quaternion), outline, points)  # type: ignore[arg-type]


def _line(
    settings: Settings, objects: list[_Placed], aimed: bool, rng: np.random.Generator
) -> tuple[tuple[float, float], tuple[float, float], float] | None:
    """Start, end and gripper yaw of a line that starts clear of all objects; if aimed, through an object's centre."""
    low = np.array([settings.workspace_x[0], settings.workspace_y[0]]) - LINE_MARGIN_M
    high = np.array([settings.workspace_x[1], settings.workspace_y[1]]) + LINE_MARGIN_M
    for _ in range(40):
        yaw = float(rng.uniform(-YAW_RAD, YAW_RAD))
        if aimed:
            target = np.array(objects[int(rng.integers(len(objects)))].placement.position[:2])
            angle = rng.uniform(-np.pi, np.pi)
            direction = np.array([np.cos(angle), np.sin(angle)])
            start = target - rng.uniform(*RUN_UP_M) * direction
            end = target + rng.uniform(*RUN_ON_M) * direction
        else:
            start, end = rng.uniform(low, high), rng.uniform(low, high)
        ends = np.stack([start, end])
        if (ends < low).any() or (ends > high).any() or np.linalg.norm(end - start) < MIN_LINE_M:
            continue
        hand = rectangle(start, GRIPPER_M, yaw)
        clear = all(separate(hand, each.outline, MARGIN_M) for each in objects)
        if clear and all(_in_picture(settings, _pushed(each, start, end, hand)) for each in objects):
            return (float(start[0]), float(start[1])), (float(end[0]), float(end[1])), yaw
    return None


def _in_picture(settings: Settings, points: np.ndarray) -> bool:
    pixels, _ = settings.camera.project(points, settings.image_size)
    border = BORDER * settings.image_size
    return bool((pixels >= border).all() and (pixels <= settings.image_size - border).all())


def _pushed(each: _Placed, start: np.ndarray, end: np.ndarray, hand: np.ndarray) -> np.ndarray:
    """Approximate final vertices of an object when the hand, with corners `hand` (4, 2) at `start`, moves to `end`.

    The object is assumed to slide before the hand without turning. The simulation checks later whether it stays inside
    the image; this cheaply drops lines that would certainly push it out.
    """
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    across = np.array([-along[1], along[0]])
    hand, outline = hand - start, each.outline - start
    apart = max((hand @ across).min() - (outline @ across).max(), (outline @ across).min() - (hand @ across).max())
    shift = length + (hand @ along).max() - (outline @ along).min()
    if apart > 0 or shift < 0 or (outline @ along).max() < (hand @ along).min():
        return each.points
    return each.points + np.array([*(shift * along), 0.0])
