"""Pixels of a convex hull, one by one: of the hull itself, and of the polygon of 32 tangents that stands for it."""

from __future__ import annotations

import math

import cv2
import numpy as np
from torch import Tensor


def hull_count(mask: Tensor, counted: Tensor, reach: float = 0.0) -> int:
    """Counted pixels whose centre lies in the hull of the mask's pixel centres, or at most `reach` pixels outside."""
    points = np.argwhere(mask.numpy())[:, ::-1].astype(np.float32)
    if not len(points):
        return 0
    hull = cv2.convexHull(points)
    return sum(
        cv2.pointPolygonTest(hull, (float(x), float(y)), True) >= -reach - 1e-3 for y, x in np.argwhere(counted.numpy())
    )


def in_tangents(mask: Tensor, counted: Tensor) -> int:
    """Counted pixels that no tangent of the mask's pixel centres, one in every 1/32 of a turn, keeps out."""
    points = np.argwhere(mask.numpy()).astype(float)
    if not len(points):
        return 0
    normals = [(math.sin(a), math.cos(a)) for a in np.arange(32) * math.pi / 16]
    farthest = [max(points @ normal) for normal in normals]
    return sum(
        all(y * s + x * c <= far + 1e-3 for (s, c), far in zip(normals, farthest, strict=True))
        for y, x in np.argwhere(counted.numpy())
    )
