"""Identities over time for models that have none (SPACE, Slot Attention): an extra, no part of the paper's tables."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Int64, Integer
from scipy.optimize import linear_sum_assignment

from apex_lab.metrics.contingency import PAD, compact, contingency


def link_frames(prediction: Integer[np.ndarray, "T H W"]) -> Int64[np.ndarray, "T H W"]:
    """Links the segments of consecutive frames by Hungarian matching of their masks (metrics.md section 2.4).

    A segment takes over the identity of the segment of the frame before that it is matched with (largest total IoU,
    more than no overlap); all others get a number that was never used before. What the segments were called before
    does not matter.
    """
    frames = torch.from_numpy(np.ascontiguousarray(prediction).astype(np.int64))
    segments = [compact(frame.reshape(1, -1))[0] for frame in frames]
    names = [np.arange(int(segments[0].max()) + 1)]
    used = len(names[0])
    for before, after in pairwise(segments):
        # The segments of a frame are numbered 0, 1, ...: rows and columns of the table are these numbers.
        counts = contingency(after[:, None, None], before[:, None, None]).counts[0, 0].numpy()
        iou = counts / (counts.sum(axis=1, keepdims=True) + counts.sum(axis=0, keepdims=True) - counts)
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
