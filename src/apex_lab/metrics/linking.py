"""Identities over time for models that have none (SPACE, Slot Attention): an extra, no part of the paper's tables."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Int64, Integer
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from apex_lab.metrics.contingency import PAD, compact


def link_frames(
    prediction: Integer[np.ndarray, "T H W"], ignored: Bool[np.ndarray, "T H W"] | None = None
) -> Int64[np.ndarray, "T H W"]:
    """Links the segments of consecutive frames by Hungarian matching of their masks (metrics.md section 2.4).

    A segment takes over the identity of the segment of the frame before that it is matched with (largest total IoU,
    more than no overlap); all others get a number that was never used before. What the segments were called before
    does not matter.

    Args:
        prediction: segments, >= 0.
        ignored: pixels that belong to no segment of their frame here; what stands there changes no link.
    """
    frames = torch.from_numpy(np.ascontiguousarray(prediction).astype(np.int64))
    left_out = [None] * len(frames) if ignored is None else list(torch.from_numpy(ignored).reshape(len(frames), 1, -1))
    # The segments of a frame are numbered 0, 1, ...; rows and columns of a table of two frames are these numbers.
    segments = [compact(frame.reshape(1, -1), left_out=out)[0] for frame, out in zip(frames, left_out, strict=True)]
    names = [np.arange(int(segments[0].max()) + 1)]
    used = len(names[0])
    for (before, out_before), (after, out_after) in pairwise(zip(segments, left_out, strict=True)):
        counts = _shared(before, after, out_before, out_after)
        area_before, area_after = counts.sum(axis=1, keepdims=True), counts.sum(axis=0, keepdims=True)
        counts = counts[1:, 1:]
        iou = counts / np.maximum(area_before[1:] + area_after[:, 1:] - counts, 1)
        i, j = linear_sum_assignment(iou, maximize=True)
        same = iou[i, j] > 0
        now = np.full(iou.shape[1], PAD)
        now[j[same]] = names[-1][i[same]]
        new = np.flatnonzero(now == PAD)
        now[new] = np.arange(used, used + len(new))
        used += len(new)
        names.append(now)
    linked = [name[segment.numpy()] for name, segment in zip(names, segments, strict=True)]
    return np.concatenate(linked).reshape(prediction.shape)


def _shared(
    before: Int64[Tensor, "1 N"],
    after: Int64[Tensor, "1 N"],
    out_before: Bool[Tensor, "1 N"] | None,
    out_after: Bool[Tensor, "1 N"] | None,
) -> Int64[np.ndarray, "R C"]:
    """Pixels that the segments of two frames share; row and column 0 are the pixels that are left out."""
    rows, columns = before + 1, after + 1
    if out_before is not None and out_after is not None:
        rows, columns = rows.masked_fill(out_before, 0), columns.masked_fill(out_after, 0)
    shape = (int(before.max()) + 2, int(after.max()) + 2)
    cells = torch.bincount((rows * shape[1] + columns).flatten(), minlength=shape[0] * shape[1])
    return cells.view(shape).numpy()
