"""Poses: x, y, z in metres and a unit quaternion x, y, z, w."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def rotation(quaternion: Sequence[float] | np.ndarray) -> np.ndarray:
    """(3, 3) matrix of a unit quaternion x, y, z, w, which is not normalised: stored poses are rounded to float32."""
    x, y, z, w = (float(value) for value in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def moved(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Points (N, 3) from a body's frame to the world frame."""
    return points @ rotation(pose[3:]).T + pose[:3]
