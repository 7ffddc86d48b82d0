"""IDF1 of Ristani et al. (2016): how much of the true tracks one predicted identity each can explain.

True and predicted tracks of a video are assigned one to one so that the number of frames in which assigned tracks
agree (IoU at least `min_iou`, IDTP) is largest; IDF1 = 2 IDTP / (true + predicted occurrences). Over videos the counts
are added up, then the ratio is taken: identities of different videos never meet, so the best assignment of the whole
set is the best assignment of every video (metrics.md section 2.2).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from apex_lab.metrics.tracking import Detections


@dataclass(frozen=True)
class IdentityCounts:
    """Of one video or of many together: IDTP, and the occurrences of true objects and of predictions."""

    true_positives: int
    true_occurrences: int
    predicted_occurrences: int

    @staticmethod
    def of_video(frames: Sequence[Detections], shape: tuple[int, int], min_iou: float = 0.5) -> IdentityCounts:
        """Counts one video; `shape` is (G, P), the size of its contingency table."""
        together = np.zeros(shape, dtype=np.int64)
        for found in frames:
            together[np.ix_(found.rows, found.columns)] += found.iou >= min_iou
        best = together[linear_sum_assignment(together, maximize=True)].sum()
        return IdentityCounts(int(best), sum(len(f.rows) for f in frames), sum(len(f.columns) for f in frames))

    @staticmethod
    def total(videos: Iterable[IdentityCounts]) -> IdentityCounts:
        """All videos together."""
        videos = list(videos)
        return IdentityCounts(
            sum(v.true_positives for v in videos),
            sum(v.true_occurrences for v in videos),
            sum(v.predicted_occurrences for v in videos),
        )

    def idf1(self) -> float:
        """In [0, 1]; NaN where nothing is there to find and nothing was found."""
        occurrences = self.true_occurrences + self.predicted_occurrences
        return 2 * self.true_positives / occurrences if occurrences else math.nan
