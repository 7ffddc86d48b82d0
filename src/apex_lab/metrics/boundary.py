"""J&F of the DAVIS challenges (Pont-Tuset et al., 2017; Caelles et al., 2019; metrics.md section 4).

J is the IoU of a true and a predicted mask; F is the harmonic mean of precision and recall of their boundary pixels,
where a boundary pixel counts as found when one of the other mask lies within `tolerance` of the image diagonal,
rounded up to whole pixels. Both are 1 in a frame in which both masks are empty, and averaged over all frames of the
video per pair of tracks. Tracks are assigned one to one by their mean J (as TrackEval does; VideoSAUR assigns by J and
F together). All predicted identities can be assigned; where there are fewer than objects, empty masks make up the
number. The dataset's value is the mean over the objects of all videos. In small images F depends strongly on the
tolerance in pixels, which is therefore stored with the results.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64, Integer
from scipy.optimize import linear_sum_assignment

TOLERANCE = 0.008
"""Share of the image diagonal, DAVIS's value."""


@dataclass(frozen=True)
class BoundaryScores:
    """J and F of the O objects of one video, per frame; NaN in a frame of which every pixel is ignored."""

    j: Float64[np.ndarray, "O T"]
    f: Float64[np.ndarray, "O T"]


def tolerance_px(size: tuple[int, int], tolerance: float = TOLERANCE) -> int:
    """The tolerance in whole pixels for images of this (height, width)."""
    return math.ceil(tolerance * math.hypot(*size))


def boundary_scores(
    prediction: Integer[np.ndarray, "T H W"],
    truth: Integer[np.ndarray, "T H W"],
    counts: Int64[np.ndarray, "T G P"],
    labels: Int64[np.ndarray, " G"],
    ids: Int64[np.ndarray, " P"],
    tolerance: float = TOLERANCE,
    ignored: Bool[np.ndarray, "T H W"] | None = None,
) -> BoundaryScores:
    """Scores the objects of one video in the order of `labels[1:]`.

    Args:
        prediction: identities.
        truth: labels, 0 is the background.
        counts, labels, ids: their contingency table.
        tolerance: share of the image diagonal.
        ignored: pixels that the table does not count; they belong to no mask. Frames without any other pixel are NaN.
    """
    j, partner = assign_tracks(counts)
    found = prediction[:, None] == np.append(ids, -1)[partner][:, None, None]
    true = truth[:, None] == labels[1:, None, None]
    if ignored is not None:
        found, true = found & ~ignored[:, None], true & ~ignored[:, None]
    radius = tolerance_px(truth.shape[1:], tolerance)
    f = np.array([boundary_measure(*masks, radius) for masks in zip(found, true, strict=True)])
    scored = counts.sum(axis=(1, 2)) > 0
    return BoundaryScores(np.where(scored, j, np.nan), np.where(scored, f.reshape(len(truth), -1).T, np.nan))


def assign_tracks(counts: Int64[np.ndarray, "T G P"]) -> tuple[Float64[np.ndarray, "O T"], Int64[np.ndarray, " O"]]:
    """One-to-one assignment of objects and predicted tracks with the largest mean J.

    Returns:
        J of each object with its partner, and the partner's column (P, one past the last, for none).
    """
    shared = counts[:, 1:]
    missing = max(0, shared.shape[1] - shared.shape[2])
    shared = np.pad(shared, ((0, 0), (0, 0), (0, missing)))
    found_area = np.pad(counts.sum(axis=1), ((0, 0), (0, missing)))[:, None, :]
    union = counts.sum(axis=2)[:, 1:, None] + found_area - shared
    j = np.where(union > 0, shared / np.maximum(union, 1), 1.0)
    objects, tracks = linear_sum_assignment(j.mean(axis=0), maximize=True)
    return j[:, objects, tracks].T, np.minimum(tracks, counts.shape[2])


def boundary_measure(
    found: Bool[np.ndarray, "O H W"], true: Bool[np.ndarray, "O H W"], radius: int
) -> Float64[np.ndarray, " O"]:
    """F of O pairs of masks, in [0, 1]; 1 where neither mask has a boundary.

    Args:
        found: predicted masks.
        true: true masks.
        radius: how far apart, in pixels, boundary pixels may lie and still agree.
    """
    found_edge, true_edge = boundary(found), boundary(true)
    n_found, n_true = found_edge.sum(axis=(1, 2)), true_edge.sum(axis=(1, 2))
    precise = (found_edge & _grow(true_edge, radius)).sum(axis=(1, 2)) / np.maximum(n_found, 1)
    recalled = (true_edge & _grow(found_edge, radius)).sum(axis=(1, 2)) / np.maximum(n_true, 1)
    both = precise + recalled
    f = 2 * precise * recalled / np.where(both > 0, both, 1)
    return np.where((n_found == 0) & (n_true == 0), 1.0, f)


def boundary(masks: Bool[np.ndarray, "O H W"]) -> Bool[np.ndarray, "O H W"]:
    """Pixels that differ from the one to the right, below, or below to the right, inside the image."""
    edge = np.zeros_like(masks)
    edge[:, :, :-1] |= masks[:, :, :-1] != masks[:, :, 1:]
    edge[:, :-1] |= masks[:, :-1] != masks[:, 1:]
    edge[:, :-1, :-1] |= masks[:, :-1, :-1] != masks[:, 1:, 1:]
    return edge


def _grow(masks: Bool[np.ndarray, "O H W"], radius: int) -> Bool[np.ndarray, "O H W"]:
    """Adds every pixel within `radius` of a mask."""
    offset = np.arange(-radius, radius + 1)
    disk = (offset[:, None] ** 2 + offset[None, :] ** 2 <= radius**2).astype(np.uint8)
    if not len(masks):
        return masks
    return np.stack([cv2.dilate(mask, disk) for mask in masks.astype(np.uint8)]).astype(bool)
