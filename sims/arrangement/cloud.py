"""From masks and depth to bodies on the table: points, place, footprint, height."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sims.arrangement.types import View
from sims.camera import Camera
from sims.rectangles import rectangle

TABLE_M = 0.008
"""Points lower than this belong to the table."""
TALL_M = 0.4
"""Points higher than this belong to no object."""
LINK_M = 0.025
"""Points nearer than this belong to the same body."""
GRAIN_M = 0.003
"""Denser points, of large images, are thinned to one per cube of this side."""
NEIGHBOURS, DEVIATIONS = 8, 2.5
"""Statistical outlier removal: a point is dropped if the mean distance to its neighbours exceeds the mean of all by
this many standard deviations."""
MIN_POINTS = 12
TOP_PERCENTILE = 98
GROWN_PX = 2
"""A mask may end this many pixels before its object: these belong to no stranger."""


@dataclass(frozen=True, eq=False)
class Body:
    """One body on the table, as seen from one side.

    Attributes:
        centre: (2,) metres, of the minimum-area rectangle around its points seen from above.
        sides: long and narrow side of that rectangle in metres.
        yaw: direction of the long side in [0, pi).
        height: metres above the table.
        points: (N, 3) metres.
        pixel: distance of neighbouring points in metres.
    """

    centre: np.ndarray
    sides: tuple[float, float]
    yaw: float
    height: float
    points: np.ndarray
    pixel: float

    @property
    def outline(self) -> np.ndarray:
        """(4, 2) corners of the rectangle in metres."""
        return rectangle(self.centre, self.sides, self.yaw)


def points_of(view: View) -> np.ndarray:
    """(H, W, 3) world points of an image; NaN where the depth has no value."""
    size = view.depth.shape[0]
    middle = np.arange(size) + 0.5
    column, row = np.meshgrid(middle, middle)
    camera = view.camera
    depth = np.where(np.isfinite(view.depth) & (view.depth > camera.near_m), view.depth, np.nan).astype(np.float64)
    rays = np.stack([column, row, np.ones_like(row)], axis=-1) @ np.linalg.inv(camera.intrinsics(size)).T
    extrinsics = camera.extrinsics()
    return (rays * depth[..., None] - extrinsics[:3, 3]) @ extrinsics[:3, :3]


def body_of(view: View, points: np.ndarray, mask: np.ndarray) -> Body | None:
    """The largest body under a mask; None if there is none.

    Args:
        points: `points_of(view)`.
        mask: (H, W) bool.
    """
    bodies = _bodies(_above(points[mask]), view)
    return max(bodies, key=lambda body: len(body.points), default=None)


def strangers(view: View, points: np.ndarray, masks: list[np.ndarray], low: np.ndarray, high: np.ndarray) -> list[Body]:
    """Bodies between `low` (2,) and `high` (2,) metres that stand on the table under none of the masks."""
    covered = np.any([np.zeros(points.shape[:2], dtype=bool), *masks], axis=0)
    free = cv2.erode((~covered).astype(np.uint8), np.ones((2 * GROWN_PX + 1,) * 2, np.uint8))
    left = points[free > 0]
    with np.errstate(invalid="ignore"):
        inside = ((left[:, :2] > low) & (left[:, :2] < high)).all(axis=1)
    return _bodies(_above(left[inside]), view)


def without_outliers(points: np.ndarray) -> np.ndarray:
    """Points (N, 3) without those far from their neighbours."""
    if len(points) <= NEIGHBOURS:
        return points
    distance, _ = cKDTree(points).query(points, k=NEIGHBOURS + 1)
    mean = distance[:, 1:].mean(axis=1)
    return points[mean <= mean.mean() + DEVIATIONS * mean.std()]


def _above(points: np.ndarray) -> np.ndarray:
    """Those of the points (N, 3) that stand on the table."""
    with np.errstate(invalid="ignore"):
        return points[(points[:, 2] > TABLE_M) & (points[:, 2] < TALL_M)]


def _bodies(points: np.ndarray, view: View) -> list[Body]:
    """Bodies of connected points."""
    if len(points) and pixel_m(view.camera, view.depth.shape[0], points) < GRAIN_M:
        _, first = np.unique(np.floor(points / GRAIN_M).astype(int), axis=0, return_index=True)
        points = points[np.sort(first)]
    points = without_outliers(points)
    if len(points) < MIN_POINTS:
        return []
    pairs = cKDTree(points).query_pairs(LINK_M, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    _, group = connected_components(graph, directed=False)
    found = (points[group == number] for number in np.flatnonzero(np.bincount(group) >= MIN_POINTS))
    return [_body(each, pixel_m(view.camera, view.depth.shape[0], each)) for each in found]


def pixel_m(camera: Camera, size_px: int, points: np.ndarray) -> float:
    """Side of a pixel in metres at the mean depth of points (N, 3)."""
    return float(camera.project(points, size_px)[1].mean() / camera.intrinsics(size_px)[0, 0])


def _body(points: np.ndarray, pixel: float) -> Body:
    (x, y), (width, depth), angle = cv2.minAreaRect(points[:, :2].astype(np.float32))
    yaw = np.radians(angle) + (0.0 if width >= depth else np.pi / 2)
    # Pixel centres lie half a pixel inside the outline.
    sides = max(width, depth) + pixel, min(width, depth) + pixel
    height = float(np.percentile(points[:, 2], TOP_PERCENTILE))
    return Body(np.array([x, y]), sides, float(yaw % np.pi), height, points, pixel)
