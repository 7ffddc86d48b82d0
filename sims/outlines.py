"""Outlines of convex bodies in the picture: what they can cover, and where their shadow falls on the table."""

from __future__ import annotations

import cv2
import numpy as np

from sims.camera import Camera

SUBPIXEL_BITS = 4
PENUMBRA = 0.012
"""Blur of a shadow's edge, as a share of the picture's side."""


def cover(camera: Camera, size_px: int, points: np.ndarray) -> tuple[np.ndarray, float]:
    """What a body can cover at most: (H, W) bool, a pixel wider than the outline of its vertices, and its far end.

    Args:
        points: (N, 3) metres in the world.

    Returns:
        The pixels and the largest depth in metres; all pixels for a body that reaches before the near plane.
    """
    pixels, depth = camera.project(points, size_px)
    far = float(depth.max())
    if depth.min() < camera.near_m:
        return np.ones((size_px, size_px), dtype=bool), far
    mask = np.zeros((size_px, size_px), dtype=np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(_fixed_point(pixels, size_px)), 255, shift=SUBPIXEL_BITS)
    return np.asarray(cv2.dilate(mask, np.ones((3, 3), np.uint8))) > 0, far


def shadows(camera: Camera, size_px: int, bodies: list[np.ndarray], light: np.ndarray) -> np.ndarray:
    """Share of light that convex bodies keep from the plane z = 0, (H, W) uint8 in [0, 255], soft at the edge.

    The shadow of a convex body on a plane is the convex hull of its vertices' shadows, in the world and in the picture.

    Args:
        bodies: vertices (N, 3) of each body in metres; those below the plane count as on it.
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
    """Points (N, 2), given as (column, row) with pixel middles at + 0.5, as OpenCV draws them with `SUBPIXEL_BITS`."""
    limit = 8 * size_px
    return np.rint((np.clip(pixels, -limit, limit) - 0.5) * 2**SUBPIXEL_BITS).astype(np.int32)
