"""Overlap of true objects with predicted masks: mBO, and mIoU with Hungarian matching (metrics.md section 4).

* mBO, mean best overlap (Pont-Tuset et al., 2017): each object's best IoU with any predicted mask, mean over the
  objects. With argmax masks this is MSC-FG, but for a frame (a video) without any object, which has no value here and
  is left out of the mean.
* mIoU: objects and predicted masks are assigned one to one so that the total IoU is largest; an object without a
  partner scores 0. Unlike mBO this punishes one mask over two objects.

Both per frame, and per video on space-time volumes with identities as masks (`video_...`).
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64, Int64
from scipy.optimize import linear_sum_assignment


def object_overlap(counts: Int64[np.ndarray, "*F G P"]) -> Float64[np.ndarray, "*F G-1 P"]:
    """IoU of every object (the rows after the background's) with every predicted mask; NaN rows where invisible."""
    true_area, found_area = counts.sum(axis=-1, keepdims=True), counts.sum(axis=-2, keepdims=True)
    iou = counts / np.maximum(true_area + found_area - counts, 1)
    return np.where(true_area > 0, iou, np.nan)[..., 1:, :]


def best_overlaps(counts: Int64[np.ndarray, "*F G P"]) -> Float64[np.ndarray, "*F G-1"]:
    """Best IoU of each object; NaN where it is not visible."""
    return object_overlap(counts).max(axis=-1)


def mean_best_overlap(counts: Int64[np.ndarray, "G P"]) -> float:
    """mBO of one frame or volume, in [0, 1]; NaN without any object."""
    best = best_overlaps(counts)
    return _mean(best[~np.isnan(best)])


def mean_matched_iou(counts: Int64[np.ndarray, "G P"]) -> float:
    """mIoU of one frame or volume under the best one-to-one assignment, in [0, 1]; NaN without any object."""
    overlap = object_overlap(counts)
    visible = overlap[~np.isnan(overlap[:, 0])]
    matched = visible[linear_sum_assignment(visible, maximize=True)]
    return _mean(np.pad(matched, (0, len(visible) - len(matched))))


def _mean(values: Float64[np.ndarray, " N"]) -> float:
    return math.fsum(values) / len(values) if len(values) else math.nan
