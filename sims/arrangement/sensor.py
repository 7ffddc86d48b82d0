"""The faults of a stereo camera's depth: noise that grows with distance, coarse steps, holes at edges and spots."""

from __future__ import annotations

import zlib

import cv2
import numpy as np

BASELINE_M, FOCAL_PX = 0.055, 640.0
DISPARITY_PX = 0.1
"""Standard deviation and step of the disparity, in pixels of the sensor (focal length `FOCAL_PX`)."""
EDGE_M = 0.02
"""Neighbouring pixels whose depths differ by more than this see different surfaces: no match there."""
EDGE_LOST, LOST = 0.5, 0.01
"""Share of pixels without a value: at edges, elsewhere."""
SPOTS, SPOT_PX = 3, 0.03
"""Number of larger holes, from gloss or lack of texture, and their radius as a share of the image's side."""


def stereo(depth: np.ndarray) -> np.ndarray:
    """Depth (H, W) in metres as a stereo camera sees it; 0 where it has no value.

    The noise is a function of the image, so that a scenario has one outcome.
    """
    exact = np.ascontiguousarray(depth, dtype=np.float32)
    rng = np.random.default_rng(zlib.crc32(exact.tobytes()))
    disparity = BASELINE_M * FOCAL_PX / np.maximum(exact, 1e-3)
    disparity = disparity + rng.normal(0.0, DISPARITY_PX, exact.shape)
    noisy = BASELINE_M * FOCAL_PX / (np.rint(disparity / DISPARITY_PX) * DISPARITY_PX)
    kernel = np.ones((3, 3), np.uint8)
    edge = cv2.dilate(exact, kernel) - cv2.erode(exact, kernel) > EDGE_M
    lost = rng.random(exact.shape) < np.where(edge, EDGE_LOST, LOST)
    side = exact.shape[0]
    row, column = np.mgrid[:side, :side]
    for centre in rng.uniform(0, side, size=(SPOTS, 2)):
        lost |= np.hypot(row - centre[0], column - centre[1]) < SPOT_PX * side
    return np.where(lost, 0.0, noisy).astype(np.float32)
