"""Draws sprites: coloured shapes that move over a plain ground. A video is a function of seed, split and index.

After the idea of SpMOT in Weis et al. (2020). Object-centric models are known to do well on such data: a failure there
is a bug, not a hard data set. Imports no PyTorch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

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


def drawn(
    sprites: Sequence[Sprite], frame: int, side: int
) -> tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"]]:
    """Image and labels of a frame; a pixel belongs to the nearest sprite that covers half of it or more."""
    image = np.full((side, side, 3), GROUND, dtype=np.float64)
    labels = np.zeros((side, side), dtype=np.uint8)
    for number, sprite in enumerate(sprites, start=1):
        covered = coverage(sprite, frame, side)
        image += covered[..., None] * (np.array(COLOURS[sprite.colour]) - image)
        labels[covered >= 0.5] = number
    return np.rint(image).astype(np.uint8), labels


def coverage(sprite: Sprite, frame: int, side: int) -> Float[np.ndarray, "H W"]:
    """Share of each pixel that a sprite covers, were it alone."""
    fine = side * FINE
    mask = np.zeros((fine, fine), dtype=np.float32)
    corners = np.rint((sprite.outline(frame) * fine - 0.5) * 256).astype(np.int32)
    cv2.fillPoly(mask, [corners], 1, shift=8)
    return cv2.resize(mask, (side, side), interpolation=cv2.INTER_AREA).astype(np.float64)


def hidden(sprites: Sequence[Sprite], frame: int, side: int) -> list[float]:
    """Share of each sprite that nearer ones cover in a frame."""
    masks: list[Bool[np.ndarray, "H W"]] = [coverage(sprite, frame, side) >= 0.5 for sprite in sprites]
    found = []
    for i, mask in enumerate(masks):
        nearer = np.any(masks[i + 1 :], axis=0) if i + 1 < len(masks) else np.zeros_like(mask)
        found.append(float((mask & nearer).sum() / max(mask.sum(), 1)))
    return found
