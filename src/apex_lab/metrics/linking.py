"""Identities over time for models that have none (SPACE, Slot Attention): an extra, no part of the paper's tables."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Int64, Integer
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from apex_lab.metrics.contingency import PAD, compact


class Linker:
    """Links the segments of frame after frame by Hungarian matching of their masks (metrics.md section 2.4).

    A segment takes over the identity of the segment of the frame before that it is matched with (largest total IoU,
    more than no overlap); all others get a number that was never used before. What the segments were called before
    does not matter.

    Attributes:
        last: linked identities of the last frame, and the pixels that belonged to no segment of it; None before the
            first frame.
        used: numbers that have been given, 0 to `used` - 1.
    """

    def __init__(self) -> None:
        self.last: tuple[Int64[np.ndarray, "H W"], Bool[np.ndarray, "H W"]] | None = None
        self.used = 0

    def __call__(
        self, frame: Integer[np.ndarray, "H W"], ignored: Bool[np.ndarray, "H W"] | None = None
    ) -> Int64[np.ndarray, "H W"]:
        """Linked identities of the next frame.

        Args:
            frame: segments, >= 0.
            ignored: pixels that belong to no segment; what stands there changes no link, and what is returned there
                means nothing.
        """
        out = np.zeros(frame.shape, dtype=bool) if ignored is None else ignored
        after, names = _segments(frame, out)
        now = np.full(len(names), PAD)
        if self.last is not None:
            before, before_names = _segments(*self.last)
            counts = _shared(before, after, _flat(self.last[1]), _flat(out))
            area_before, area_after = counts.sum(axis=1, keepdims=True), counts.sum(axis=0, keepdims=True)
            counts = counts[1:, 1:]
            iou = counts / np.maximum(area_before[1:] + area_after[:, 1:] - counts, 1)
            i, j = linear_sum_assignment(iou, maximize=True)
            same = iou[i, j] > 0
            now[j[same]] = before_names[i[same]]
        new = np.flatnonzero(now == PAD)
        now[new] = np.arange(self.used, self.used + len(new))
        self.used += len(new)
        linked = now[after.numpy()].reshape(frame.shape)
        self.last = (linked, out)
        return linked


def link_frames(
    prediction: Integer[np.ndarray, "T H W"], ignored: Bool[np.ndarray, "T H W"] | None = None
) -> Int64[np.ndarray, "T H W"]:
    """Links the segments of all frames of a video; see `Linker`.

    Args:
        prediction: segments, >= 0.
        ignored: pixels that belong to no segment of their frame.
    """
    link = Linker()
    return np.stack([link(frame, None if ignored is None else ignored[t]) for t, frame in enumerate(prediction)])


def _segments(
    frame: Integer[np.ndarray, "H W"], ignored: Bool[np.ndarray, "H W"]
) -> tuple[Int64[Tensor, "1 N"], Int64[np.ndarray, " R"]]:
    """The segments of a frame numbered 0, 1, ..., which are rows and columns of a table of two frames; their names."""
    labels = torch.from_numpy(np.ascontiguousarray(frame).astype(np.int64)).reshape(1, -1)
    numbered, names = compact(labels, left_out=_flat(ignored))
    return numbered, names[0].numpy()


def _flat(mask: Bool[np.ndarray, "H W"]) -> Bool[Tensor, "1 N"]:
    return torch.from_numpy(np.ascontiguousarray(mask)).reshape(1, -1)


def _shared(
    before: Int64[Tensor, "1 N"],
    after: Int64[Tensor, "1 N"],
    out_before: Bool[Tensor, "1 N"],
    out_after: Bool[Tensor, "1 N"],
) -> Int64[np.ndarray, "R C"]:
    """Pixels that the segments of two frames share; row and column 0 are the pixels that are left out."""
    rows, columns = (before + 1).masked_fill(out_before, 0), (after + 1).masked_fill(out_after, 0)
    shape = (int(before.max()) + 2, int(after.max()) + 2)
    cells = torch.bincount((rows * shape[1] + columns).flatten(), minlength=shape[0] * shape[1])
    return cells.view(shape).numpy()
