"""Projected outlines of convex bodies: the pixels that they can cover, and their shadows on the table."""

from __future__ import annotations

import cv2
import numpy as np

from sims.camera import Camera

SUBPIXEL_BITS = 4
PENUMBRA = 0.012
"""Blur of a shadow's edge, as a share of the image's side."""


def cover(camera: Camera, size_px: int, points: np.ndarray) -> tuple[np.ndarray, float]:
    """Upper bound of the pixels that a body covers: the outline of its vertices, dilated by one pixel.

    Args:
        points: (N, 3) metres in the world.

    Returns:
        (H, W) bool, and the largest depth in metres; all pixels for a body that crosses the near plane.
    """
    pixels, depth = camera.project(points, size_px)
    far = float(depth.max())
    if depth.min() < camera.near_m:
        return np.ones((size_px, size_px), dtype=bool), far
    mask = np.zeros((size_px, size_px), dtype=np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(_fixed_point(pixels, size_px)), 255, shift=SUBPIXEL_BITS)
    return np.asarray(cv2.dilate(mask, np.ones((3, 3), np.uint8))) > 0, far


def shadows(camera: Camera, size_px: int, bodies: list[np.ndarray], light: np.ndarray) -> np.ndarray:
    """Soft shadow of convex bodies on the plane z = 0: (H, W) uint8, 255 = all direct light blocked.

    The shadow of a convex body on a plane is the convex hull of its vertices' shadows, in the world and in the image.

    Args:
        bodies: vertices (N, 3) of each body in metres; those below the plane are moved onto it.
        light: (3,) direction towards the light, upwards.
    """
    points = np.concatenate(bodies)
    fallen = points - np.maximum(points[:, 2:], 0) * (light / light[2])
    fallen[:, 2] = 0
    pixels, depth = camera.project(fallen, size_px)
    fixed = _fixed_point(pixels, size_px)
    mask = np.zeros((size_px, size_px), dtype=np.uint8)
    end = 0
    for body in bodies:
        begin, end = end, end + len(body)
        if depth[begin:end].min() >= camera.near_m:
            cv2.fillConvexPoly(mask, cv2.convexHull(fixed[begin:end]), 255, shift=SUBPIXEL_BITS)
    return cv2.GaussianBlur(mask, (0, 0), PENUMBRA * size_px)


def _fixed_point(pixels: np.ndarray, size_px: int) -> np.ndarray:
    """Points (N, 2), (column, row) with pixel centres at + 0.5, in OpenCV's fixed-point format with `SUBPIXEL_BITS`."""
    limit = 8 * size_px
    return np.rint((np.clip(pixels, -limit, limit) - 0.5) * 2**SUBPIXEL_BITS).astype(np.int32)
