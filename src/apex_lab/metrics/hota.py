"""HOTA, higher order tracking accuracy, of Luiten et al. (IJCV 2021); metrics.md section 2.2.

At each threshold alpha, detection (DetA: which objects are found) and association (AssA: do found objects keep one
identity) are measured apart, HOTA_alpha = sqrt(DetA AssA), and HOTA is the mean over alpha = 0.05, 0.10, ..., 0.95.
Predictions are assigned per frame so that IoU, weighted by how well two tracks agree over the whole video, is largest;
this is not the CLEAR matching. Small masks and the background are removed first, as for CLEAR. Over videos the counts
are added up before HOTA is taken; it is not the mean of the videos' HOTAs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.optimize import linear_sum_assignment

from apex_lab.metrics.tracking import Detections

ALPHAS = np.arange(1, 20) / 20
"""The IoU thresholds."""

_SLACK = 1e-12
"""An IoU is a ratio of pixel counts; one that equals a threshold may lie a rounding below it."""

_EMPTY_LOC = 1.0
"""LocA where nothing was found at all, by convention."""


@dataclass(frozen=True)
class HotaCounts:
    """Of one video or of many together, at the A = 19 thresholds.

    Attributes:
        true_positives, misses, false_positives: pairs, true objects without one, predictions without one.
        association, recall, precision: sums over true positives of A(c), and of the shares of the true and of the
            predicted track that the pair's true positives make up.
        location: sum of IoU over true positives.
    """

    true_positives: Int64[np.ndarray, " A"]
    misses: Int64[np.ndarray, " A"]
    false_positives: Int64[np.ndarray, " A"]
    association: Float64[np.ndarray, " A"]
    recall: Float64[np.ndarray, " A"]
    precision: Float64[np.ndarray, " A"]
    location: Float64[np.ndarray, " A"]

    @staticmethod
    def of_video(frames: Sequence[Detections], shape: tuple[int, int]) -> HotaCounts:
        """Counts one video; `shape` is (G, P), the size of its contingency table."""
        true_count, found_count = np.zeros(shape[0], dtype=np.int64), np.zeros(shape[1], dtype=np.int64)
        for found in frames:
            true_count[found.rows] += 1
            found_count[found.columns] += 1
        agreement = _track_agreement(frames, true_count, found_count)
        pairs = np.zeros((len(ALPHAS), *shape), dtype=np.int64)
        location: list[list[float]] = [[] for _ in ALPHAS]
        for found in frames:
            i, j = linear_sum_assignment(found.iou * agreement[np.ix_(found.rows, found.columns)], maximize=True)
            for a, alpha in enumerate(ALPHAS):
                good = found.iou[i, j] >= alpha - _SLACK
                pairs[a, found.rows[i[good]], found.columns[j[good]]] += 1
                location[a].extend(found.iou[i, j][good])
        true_positives = pairs.sum(axis=(1, 2))
        of_true, of_found = true_count[:, None], found_count[None, :]
        return HotaCounts(
            true_positives=true_positives,
            misses=true_count.sum() - true_positives,
            false_positives=found_count.sum() - true_positives,
            association=_sum_of_shares(pairs, of_true + of_found - pairs),
            recall=_sum_of_shares(pairs, of_true),
            precision=_sum_of_shares(pairs, of_found),
            location=np.array([math.fsum(values) for values in location]),
        )

    @staticmethod
    def total(videos: Iterable[HotaCounts]) -> HotaCounts:
        """All videos together; their order changes no digit."""
        videos = list(videos)
        integers = ("true_positives", "misses", "false_positives")
        floats = ("association", "recall", "precision", "location")
        zero = np.zeros(len(ALPHAS), dtype=np.int64)
        summed = {name: sum((getattr(v, name) for v in videos), zero) for name in integers}
        exact = {name: np.array([math.fsum(getattr(v, name)[a] for v in videos) for a in range(19)]) for name in floats}
        return HotaCounts(**summed, **exact)

    def curves(self) -> dict[str, Float64[np.ndarray, " A"]]:
        """`hota deta assa detre detpr assre asspr loca` per threshold, each in [0, 1].

        All NaN where nothing was there to find and nothing was found; without any true positive all are 0 but LocA,
        which is 1.
        """
        found, true = self.true_positives + self.false_positives, self.true_positives + self.misses
        matched = np.maximum(self.true_positives, 1)
        deta = self.true_positives / np.maximum(found + self.misses, 1)
        assa = self.association / matched
        curves = {
            "hota": np.sqrt(deta * assa),
            "deta": deta,
            "assa": assa,
            "detre": self.true_positives / np.maximum(true, 1),
            "detpr": self.true_positives / np.maximum(found, 1),
            "assre": self.recall / matched,
            "asspr": self.precision / matched,
            "loca": np.where(self.true_positives > 0, self.location / matched, _EMPTY_LOC),
        }
        undefined = found + true == 0
        return {name: np.where(undefined, np.nan, curve) for name, curve in curves.items()}

    def means(self) -> dict[str, float]:
        """The means of `curves` over the thresholds, and `hota0`, HOTA at alpha = 0.05."""
        curves = self.curves()
        means = {name: math.fsum(curve) / len(ALPHAS) for name, curve in curves.items()}
        return means | {"hota0": float(curves["hota"][0])}


def _track_agreement(
    frames: Sequence[Detections], true_count: Int64[np.ndarray, " G"], found_count: Int64[np.ndarray, " P"]
) -> Float64[np.ndarray, "G P"]:
    """Jaccard overlap of every two tracks over the video, with IoUs that compete in a frame sharing one vote."""
    together = np.zeros((len(true_count), len(found_count)))
    for found in frames:
        competing = found.iou.sum(axis=1, keepdims=True) + found.iou.sum(axis=0, keepdims=True) - found.iou
        together[np.ix_(found.rows, found.columns)] += found.iou / np.where(competing > 0, competing, 1)
    either = true_count[:, None] + found_count[None, :] - together
    return together / np.where(either > 0, either, 1)


def _sum_of_shares(pairs: Int64[np.ndarray, "A G P"], whole: Int64[np.ndarray, "..."]) -> Float64[np.ndarray, " A"]:
    """Over all true positives of each threshold: the share that their pair's true positives have of `whole`."""
    shares = pairs * (pairs / np.maximum(whole, 1))
    return np.array([math.fsum(of_alpha.ravel()) for of_alpha in shares])
