"""Turned rectangles on the table, and whether they lie apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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


@dataclass(frozen=True)
class Rectangles:
    """N turned rectangles: centres (N, 2), sides (N, 2) in metres, yaws (N,) in radians."""

    centres: np.ndarray
    sides: np.ndarray
    yaws: np.ndarray

    def __getitem__(self, rows: slice | np.ndarray) -> Rectangles:
        return Rectangles(self.centres[rows], self.sides[rows], self.yaws[rows])

    def joined(self, others: Rectangles) -> Rectangles:
        """(N + M) rectangles."""
        return Rectangles(
            np.concatenate([self.centres, others.centres]),
            np.concatenate([self.sides, others.sides]),
            np.concatenate([self.yaws, others.yaws]),
        )

    def gaps(self, others: Rectangles) -> np.ndarray:
        """(N, M) the largest gap between two rectangles along one of their sides, negative if they overlap.

        `separate` of two rectangles is: their gap is at least the margin.
        """
        shift = self.centres[:, None] - others.centres
        turn = self.yaws[:, None] - others.yaws
        cosine, sine = np.abs(np.cos(turn)), np.abs(np.sin(turn))
        (a, b), (c, d) = self.sides.T[:, :, None] / 2, others.sides.T / 2
        along, across = _in_axes(shift, self.yaws[:, None])
        gaps = [along - (a + c * cosine + d * sine), across - (b + c * sine + d * cosine)]
        along, across = _in_axes(shift, others.yaws)
        gaps += [along - (c + a * cosine + b * sine), across - (d + a * sine + b * cosine)]
        return np.asarray(np.max(gaps, axis=0))


def _in_axes(shift: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sizes of the components of shifts (N, M, 2) along and across directions."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.abs(shift[..., 0] * cosine + shift[..., 1] * sine), np.abs(shift[..., 1] * cosine - shift[..., 0] * sine)
