"""Outlines of convex bodies in the picture: where a body may cover something, and where its shadow falls on the table."""

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
    mask = np.zeros((size_px, size_px), dtype=np.uint8)
    if depth.min() < camera.near_m:
        mask[:] = 1
    else:
        _fill(mask, pixels)
        mask = cv2.dilate(mask, np.ones((3, 3), np.uint8))
    return mask > 0, float(depth.max())


def shadows(camera: Camera, size_px: int, bodies: list[np.ndarray], light: np.ndarray) -> np.ndarray:
    """Share of light that convex bodies keep from the plane z = 0, (H, W) float32 in [0, 1], soft at the edge.

    The shadow of a convex body on a plane is the convex hull of its vertices' shadows, in the world and in the picture.

    Args:
        bodies: vertices (N, 3) of each body in metres; those below the plane count as on it.
        light: (3,) direction towards the light, upwards.
    """
    points = np.concatenate(bodies)
    fallen = points - np.maximum(points[:, 2:], 0) * (light / light[2])
    fallen[:, 2] = 0
    pixels, depth = camera.project(fallen, size_px)
    mask = np.zeros((size_px, size_px), dtype=np.uint8)
    begin = 0
    for body in bodies:
        end = begin + len(body)
        if depth[begin:end].min() >= camera.near_m:
            _fill(mask, pixels[begin:end])
        begin = end
    return cv2.GaussianBlur(mask, (0, 0), PENUMBRA * size_px).astype(np.float32) / 255


def _fill(mask: np.ndarray, pixels: np.ndarray) -> None:
    """Fill the convex hull of points (N, 2), given as (column, row) with pixel middles at + 0.5."""
    limit = 8 * mask.shape[0]
    fixed = np.rint((np.clip(pixels, -limit, limit) - 0.5) * 2**SUBPIXEL_BITS).astype(np.int32)
    cv2.fillConvexPoly(mask, cv2.convexHull(fixed), 255, lineType=cv2.LINE_8, shift=SUBPIXEL_BITS)
