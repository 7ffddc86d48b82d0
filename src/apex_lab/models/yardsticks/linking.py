"""Identities over time for regions that were found frame by frame.

Legend: T frames, N regions per frame (padded with empty masks), H, W image height and width.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from apex_lab.scene import ABSENT

COLOR_SCALE = 0.2
"""Distance in RGB (each channel in [0, 1]) at which the likeness of two colours has fallen to exp(-1)."""


@dataclass(frozen=True)
class Linked:
    """The regions of the last frame, from which the next ones are linked.

    Attributes:
        masks: (N, P) of 0 and 1, one row per region.
        colors: (N, 3).
        ids: (N,).
        free: the next number that no region has had.
    """

    masks: Float[np.ndarray, "N P"]
    colors: Float[np.ndarray, "N 3"]
    ids: Int[np.ndarray, " N"]
    free: int


def link(
    masks: Bool[np.ndarray, "T N H W"],
    colors: Float[np.ndarray, "T N 3"],
    min_similarity: float = 0.3,
    before: Linked | None = None,
) -> tuple[Int[np.ndarray, "T N"], Linked]:
    """Links regions of consecutive frames by Hungarian matching of mask overlap and colour.

    Two regions are as similar as the mean of their IoU and of the likeness exp(-d / `COLOR_SCALE`) of their colours.
    Pairs that do not overlap, or are less similar than `min_similarity`, are never linked; among the others the
    assignment with the largest total similarity is taken. A region without a partner in the frame before gets the
    next free number, so a number never comes back: whatever vanishes for a frame returns under a new one.

    Args:
        masks: the regions; an empty mask means that there is none. Regions may overlap.
        colors: mean RGB of each region in [0, 1]; ignored where the mask is empty.
        min_similarity: in [0, 1].
        before: the last frame of the chunk before; None at the start of a video.

    Returns:
        Identities from 1 up in order of appearance (0 is left to a background), `ABSENT` for empty masks; and the last
        frame.
    """
    frames, regions = masks.shape[:2]
    flat = masks.reshape(frames, regions, masks[0, 0].size if regions else 0).astype(np.float32)
    areas = flat.sum(axis=2)
    ids = np.full((frames, regions), ABSENT, dtype=np.int64)
    last = before or Linked(flat[0, :0], colors[0, :0], ids[0, :0], 1)
    for t in range(frames):
        here = np.flatnonzero(areas[t])
        similarity = _similarity(last.masks, flat[t, here], last.colors, colors[t, here])
        similarity[similarity < min_similarity] = 0.0
        for i, j in zip(*linear_sum_assignment(similarity, maximize=True), strict=True):
            if similarity[i, j] > 0:
                ids[t, here[j]] = last.ids[i]
        new = here[ids[t, here] == ABSENT]
        ids[t, new] = np.arange(last.free, last.free + len(new))
        last = Linked(flat[t, here], colors[t, here], ids[t, here], last.free + len(new))
    return ids, last


def _similarity(
    masks_a: Float[np.ndarray, "A P"],
    masks_b: Float[np.ndarray, "B P"],
    colors_a: Float[np.ndarray, "A 3"],
    colors_b: Float[np.ndarray, "B 3"],
) -> Float[np.ndarray, "A B"]:
    """Mean of IoU and likeness of colour, in [0, 1]; 0 for pairs that do not overlap. Masks are not empty."""
    overlap = masks_a @ masks_b.T
    iou = overlap / (masks_a.sum(axis=1)[:, None] + masks_b.sum(axis=1)[None, :] - overlap)
    distance = np.linalg.norm(colors_a[:, None] - colors_b[None, :], axis=2)
    return np.where(overlap > 0, (iou + np.exp(-distance / COLOR_SCALE)) / 2, 0.0)
