"""Pixels of a convex hull, one by one."""

from __future__ import annotations

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
