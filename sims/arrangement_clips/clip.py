"""One clip: objects on the table, some of which slide without touching each other, and its frames.

Legend: T frames, O objects, S image size.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from PIL import Image
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from sims.arrangement.scenario import MARGIN_M, Placement, layout
from sims.arrangement.studio import studio
from sims.arrangement_clips.settings import Settings
from sims.assets import object_models
from sims.poses import moved
from sims.rectangles import separate

SPLITS = ("train", "val", "test")
TRIES = 60
"""Draws of one object's way before it stays where it is."""
TURN_RAD = np.pi / 3
"""Greatest turn of an object in a clip."""
LEAST = 0.3
"""Shortest way, as a share of the longest."""


@dataclass(frozen=True)
class Clip:
    """What a clip shows, as pure data.

    Attributes:
        names: class of each object.
        poses: (T, O, 7) position in metres and quaternion (x, y, z, w) of its frame.
    """

    names: tuple[str, ...]
    poses: np.ndarray


@dataclass(frozen=True)
class Frames:
    """The images of a clip.

    Attributes:
        rgb: (T, S, S, 3) uint8.
        segmentation: (T, S, S) uint8: 0 background, 2 + i object i, as in P2D.
    """

    rgb: np.ndarray
    segmentation: np.ndarray


def sample(settings: Settings, split: str, index: int) -> Clip:
    """The clip with this number; a function of the arguments alone, and of none of the task's scenarios.

    Raises:
        SimError: the settings leave the objects no room.
    """
    word = int.from_bytes(hashlib.sha256(b"arrangement clip").digest()[:8], "little")
    rng = np.random.default_rng(np.random.SeedSequence([settings.seed, word, SPLITS.index(split), index]))
    count = int(rng.integers(settings.min_objects, settings.max_objects + 1))
    names = tuple(str(name) for name in rng.choice(settings.objects, size=count, replace=False))
    start = layout(settings.task, names, rng)
    moves = rng.random(count) < settings.moving
    if settings.moving > 0:
        moves[rng.integers(count)] = True
    return Clip(names, _slid(settings, start, np.flatnonzero(moves).tolist(), rng))


def _slid(settings: Settings, start: tuple[Placement, ...], movers: list[int], rng: np.random.Generator) -> np.ndarray:
    """(T, O, 7) poses; an object for which no free way is found stays at its start."""
    poses = np.tile([place.pose for place in start], (settings.frames, 1, 1))
    outlines = [_outlines(place.name, poses[:, number]) for number, place in enumerate(start)]
    for number in movers:
        for _ in range(TRIES):
            way = _way(settings, poses[0, number], rng)
            own = _outlines(start[number].name, way)
            others = [each for other, each in enumerate(outlines) if other != number]
            apart = all(separate(own[t], each[t], MARGIN_M) for each in others for t in range(settings.frames))
            if apart and _inside(settings, start[number].name, way[-1]):
                poses[:, number], outlines[number] = way, own
                break
    return poses


def _way(settings: Settings, pose: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(T, 7) poses along a straight line of random direction and length, turning steadily."""
    share = np.linspace(0, 1, settings.frames)
    longest = settings.step_m * (settings.frames - 1)
    direction, turn = rng.uniform(-np.pi, np.pi), rng.uniform(-TURN_RAD, TURN_RAD)
    shift = rng.uniform(LEAST, 1) * longest * np.array([np.cos(direction), np.sin(direction), 0])
    turned = Rotation.from_euler("z", share[:, None] * turn) * Rotation.from_quat(pose[3:])
    return np.concatenate([pose[:3] + share[:, None] * shift, turned.as_quat()], axis=1)


def _outlines(name: str, poses: np.ndarray) -> list[np.ndarray]:
    """The convex outline (N, 2) of an object on the table, in every frame."""
    (model,) = object_models((name,))
    first = moved(model.touching, poses[0])[:, :2]
    hull = ConvexHull(first).vertices
    return [moved(model.touching[hull], pose)[:, :2] for pose in poses]


def _inside(settings: Settings, name: str, pose: np.ndarray) -> bool:
    """Whether an object is in the workspace and not cut off by the image."""
    low, high = np.transpose([settings.workspace_x, settings.workspace_y])
    if (pose[:2] < low).any() or (pose[:2] > high).any():
        return False
    (model,) = object_models((name,))
    pixels, _ = settings.camera.project(moved(model.vertices, pose), settings.render_size)
    return bool((pixels >= 0).all() and (pixels <= settings.render_size).all())


def drawn(settings: Settings, clip: Clip) -> Frames:
    """Renders a clip."""
    camera = studio(settings.task)
    rgb, segmentation = [], []
    for poses in clip.poses:
        view = camera.view(clip.names, poses)
        assert view.truth is not None
        rgb.append(shrunk(view.rgb, settings.image_size))
        segmentation.append(shrunk_labels(view.truth.segmentation, settings.image_size))
    return Frames(np.stack(rgb), np.stack(segmentation))


def shrunk(rgb: np.ndarray, size: int) -> np.ndarray:
    """An image (H, W, 3) at another size (S, S, 3): bilinear, antialiased, as models get the task's images."""
    if rgb.shape[0] == size:
        return rgb
    return np.asarray(Image.fromarray(rgb).resize((size, size), Image.Resampling.BILINEAR))


def shrunk_labels(labels: np.ndarray, size: int) -> np.ndarray:
    """Labels (H, W) at another size: the label with the largest share of the pixel, weighed as colours are."""
    if labels.shape[0] == size:
        return labels
    known = np.unique(labels)
    shares = [
        np.asarray(Image.fromarray((labels == one).astype(np.float32)).resize((size, size), Image.Resampling.BILINEAR))
        for one in known
    ]
    return known[np.argmax(shares, axis=0)]
