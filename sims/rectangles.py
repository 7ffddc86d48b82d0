"""Turned rectangles on the table, and whether they lie apart."""

from __future__ import annotations

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
