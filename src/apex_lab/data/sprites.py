"""Sprites: coloured shapes that move over a plain ground, drawn when they are read, so nothing is stored.

After the idea of SpMOT in Weis et al. (2020). Object-centric models are known to do well on
such data: a failure here is a bug, not a hard data set.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Annotated, Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from pydantic import Field
from torch import Tensor

from apex_lab.base.errors import UserError
from apex_lab.data.source import VideoSource
from apex_lab.data.video_set import Clip, VideoSet
from apex_lab.metrics.objects import ObjectMetadata

VERSION = 1
"""Raised when the same settings give other pixels."""

SPLITS = ("train", "val", "test")
SHAPES = ("disc", "square", "triangle", "diamond", "cross")
COLOURS = ((230, 25, 75), (60, 180, 75), (255, 225, 25), (0, 130, 200), (245, 130, 48), (145, 30, 180), (70, 240, 240))
GROUND = (40, 40, 40)
FINE = 4
"""Shapes are drawn at so many times the resolution and averaged."""


@dataclass(frozen=True)
class Sprite:
    """One shape of a video; positions in units of the image side.

    Attributes:
        shape, colour: index in `SHAPES`, in `COLOURS`.
        radius: of the circle around it.
        angle: rad.
        start: (x, y) of its centre in the first frame.
        velocity: (x, y) per frame; it is thrown back at the image's rim.
    """

    shape: int
    colour: int
    radius: float
    angle: float
    start: tuple[float, float]
    velocity: tuple[float, float]

    def centre(self, frame: int) -> tuple[float, float]:
        """Where its centre is in a frame."""
        low, high = self.radius, 1 - self.radius
        x, y = (
            low + _bounce(at + frame * speed - low, high - low)
            for at, speed in zip(self.start, self.velocity, strict=True)
        )
        return x, y

    def outline(self, frame: int) -> Float[np.ndarray, "V 2"]:
        """Its corners (x, y) in a frame."""
        corners = _corners(SHAPES[self.shape])
        turn = np.array([[np.cos(self.angle), -np.sin(self.angle)], [np.sin(self.angle), np.cos(self.angle)]])
        return corners @ turn.T * self.radius + np.array(self.centre(frame))


def _bounce(position: float, length: float) -> float:
    """A position on a line folded into [0, length]."""
    folded = position % (2 * length)
    return folded if folded <= length else 2 * length - folded


def _corners(shape: str) -> Float[np.ndarray, "V 2"]:
    """Corners within the unit circle."""
    if shape == "cross":
        a, b = 0.3, 0.95
        points = [
            (-a, -b),
            (a, -b),
            (a, -a),
            (b, -a),
            (b, a),
            (a, a),
            (a, b),
            (-a, b),
            (-a, a),
            (-b, a),
            (-b, -a),
            (-a, -a),
        ]
        return np.array(points)
    count, stretch = {"disc": (48, 1.0), "square": (4, 1.0), "triangle": (3, 1.0), "diamond": (4, 0.6)}[shape]
    angles = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angles), stretch * np.sin(angles)], axis=1)


def draw_sprites(seed: int, split: str, index: int, counts: tuple[int, int]) -> list[Sprite]:
    """The sprites of a video, the nearest last; a function of the arguments alone."""
    draw = np.random.default_rng([seed, SPLITS.index(split), index])
    number = int(draw.integers(counts[0], counts[1] + 1))
    colours = draw.permutation(len(COLOURS))[:number]
    found = []
    for colour in colours:
        radius = float(draw.uniform(0.09, 0.15))
        heading, speed = draw.uniform(0, 2 * np.pi), draw.uniform(0.01, 0.04)
        found.append(
            Sprite(
                shape=int(draw.integers(len(SHAPES))),
                colour=int(colour),
                radius=radius,
                angle=float(draw.uniform(0, 2 * np.pi)),
                start=(float(draw.uniform(radius, 1 - radius)), float(draw.uniform(radius, 1 - radius))),
                velocity=(float(speed * np.cos(heading)), float(speed * np.sin(heading))),
            )
        )
    return found


class Sprites(VideoSet):
    """One split. Labels: 0 the ground, 1 and up the sprites, each the same number through the video.

    Args:
        seed: of all splits.
        split: "train", "val" or "test".
        videos, frames, side: sizes; `side` in pixels.
        counts: fewest and most sprites of a video.
    """

    def __init__(self, seed: int, split: str, videos: int, frames: int, side: int, counts: tuple[int, int]) -> None:
        self.seed, self.split, self.counts = seed, split, counts
        self.videos, self.frames, self.side = videos, frames, side

    def __len__(self) -> int:
        return self.videos

    def length(self, video: int) -> int:
        """Frames of a video; all have the same number."""
        return self.frames

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) in pixels."""
        return self.side, self.side

    def name(self, video: int) -> str:
        """As exports name it."""
        return f"{self.split}_{video:05d}"

    def read(self, clip: Clip) -> dict[str, Tensor]:
        """Draws a clip."""
        sprites = draw_sprites(self.seed, self.split, clip.video, self.counts)
        stop = self.frames if clip.frames is None else clip.start + clip.frames
        if not 0 <= clip.start < stop <= self.frames:
            raise IndexError(f"frames {clip.start} to {stop - 1} of a video that has {self.frames}")
        drawn = [self._frame(sprites, frame) for frame in range(clip.start, stop)]
        images, labels = zip(*drawn, strict=True)
        return {
            "video": torch.from_numpy(np.stack(images).transpose(0, 3, 1, 2).copy()),
            "segmentation": torch.from_numpy(np.stack(labels)),
        }

    def _frame(self, sprites: list[Sprite], frame: int) -> tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"]]:
        """Image and labels; a pixel belongs to the nearest sprite that covers half of it or more."""
        image = np.full((self.side, self.side, 3), GROUND, dtype=np.float64)
        labels = np.zeros((self.side, self.side), dtype=np.uint8)
        for number, sprite in enumerate(sprites, start=1):
            covered = self._coverage(sprite, frame)
            image += covered[..., None] * (np.array(COLOURS[sprite.colour]) - image)
            labels[covered >= 0.5] = number
        return np.rint(image).astype(np.uint8), labels

    def _coverage(self, sprite: Sprite, frame: int) -> Float[np.ndarray, "H W"]:
        """Share of each pixel that a sprite covers, were it alone."""
        fine = self.side * FINE
        mask = np.zeros((fine, fine), dtype=np.float32)
        corners = np.rint((sprite.outline(frame) * fine - 0.5) * 256).astype(np.int32)
        cv2.fillPoly(mask, [corners], 1, shift=8)
        return cv2.resize(mask, (self.side, self.side), interpolation=cv2.INTER_AREA).astype(np.float64)

    def metadata(self, video: int) -> ObjectMetadata:
        """Shape as the class, and hidden share per frame."""
        sprites = draw_sprites(self.seed, self.split, video, self.counts)
        alone = [[self._coverage(sprite, t) >= 0.5 for sprite in sprites] for t in range(self.frames)]
        return ObjectMetadata(
            labels=np.arange(1, len(sprites) + 1),
            classes=[SHAPES[sprite.shape] for sprite in sprites],
            occlusion=np.array([_hidden(frame) for frame in alone]),
        )


def _hidden(masks: list[Bool[np.ndarray, "H W"]]) -> list[float]:
    """Share of each sprite that nearer ones cover."""
    found = []
    for i, mask in enumerate(masks):
        nearer = np.any(masks[i + 1 :], axis=0) if i + 1 < len(masks) else np.zeros_like(mask)
        found.append(float((mask & nearer).sum() / max(mask.sum(), 1)))
    return found


class SpritesSource(VideoSource):
    """Sprites with the given settings; nothing is stored.

    Args:
        data_seed: of all videos.
        train, val, test: videos per split.
        frames: per video.
        image_size: height and width in pixels.
        min_objects, max_objects: fewest and most sprites of a video.
        workers: processes that draw training clips; 0 draws in the training process.

    Raises:
        UserError: more sprites than colours, or fewer at most than at least.
    """

    def __init__(
        self,
        data_seed: Annotated[int, Field(ge=0)] = 0,
        train: Annotated[int, Field(gt=0)] = 2000,
        val: Annotated[int, Field(ge=0)] = 200,
        test: Annotated[int, Field(ge=0)] = 200,
        frames: Annotated[int, Field(gt=0)] = 20,
        image_size: Annotated[int, Field(ge=16, le=1024)] = 128,
        min_objects: Annotated[int, Field(ge=0)] = 1,
        max_objects: Annotated[int, Field(ge=1, le=len(COLOURS))] = 4,
        workers: Annotated[int, Field(ge=0)] = 2,
    ) -> None:
        if min_objects > max_objects:
            raise UserError(f"min_objects = {min_objects} is above max_objects = {max_objects}")
        self.workers = workers
        self.settings = {
            **{"data_seed": data_seed, "train": train, "val": val, "test": test, "frames": frames},
            **{"image_size": image_size, "min_objects": min_objects, "max_objects": max_objects},
        }
        self.sets: dict[str, Sprites] = {}

    def prepare(self) -> None:
        """Nothing to fetch."""

    def open(self) -> None:
        """Makes the splits."""
        settings = self.settings
        self.sets = {
            split: Sprites(
                settings["data_seed"],
                split,
                settings[split],
                settings["frames"],
                settings["image_size"],
                (settings["min_objects"], settings["max_objects"]),
            )
            for split in SPLITS
        }

    @property
    def fingerprint(self) -> str:
        """32 hex digits that are equal only for equal videos."""
        return hashlib.sha256(repr((VERSION, sorted(self.settings.items()))).encode()).hexdigest()[:32]

    def describe(self) -> dict[str, Any]:
        """What a record keeps about the data."""
        return {"name": "sprites", "fingerprint": self.fingerprint, "version": VERSION, "settings": self.settings}
