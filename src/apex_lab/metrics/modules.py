"""torchmetrics classes over the segmentation metrics: the same numbers in any order, batch size or process count."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from apex_lab.metrics.contingency import Contingency, Labels, contingency
from apex_lab.metrics.segmentation import SCORES, Mode, ari_name, covering_name, video_scores

PAPER_SCORES = ("ari_fg", "msc_fg", "ari", "msc")
"""The columns of the paper's segmentation tables, in their order."""

_BITS = 53
_LOW_BITS = 32


def encode_sum(values: Float64[Tensor, "... N"]) -> Int64[Tensor, "... 2"]:
    """The sum over the last axis of values in [-1, 1], NaN left out, as an integer in units of 2^-53.

    Integers add up to the same total in every order, which floating-point numbers do not. High and low part are kept
    apart, so two billion values fit.
    """
    units = (values.nan_to_num(nan=0.0) * 2.0**_BITS).round().long()
    return torch.stack([(units >> _LOW_BITS).sum(-1), (units & (2**_LOW_BITS - 1)).sum(-1)], dim=-1)


def decode_mean(parts: Int64[Tensor, "2"], count: int) -> float:
    """The mean of `count` values whose sums `encode_sum` made, rounded once; NaN for none."""
    high, low = (int(part) for part in parts)
    return ((high << _LOW_BITS) + low) / (count << _BITS) if count else float("nan")


class SegmentationScore(Metric):
    """Mean of one segmentation score over all frames (or videos) seen.

    Args:
        name: one of `segmentation.SCORES`.
        mode: `frame` and `frame_then_video` differ in who has one vote, frame or video; see `segmentation`.
        skip_empty: leaves frames without any object out of the foreground means.
        ignore_label: pixels of this true label are left out.

    `compute()` is a 0-dim float64 tensor, NaN before any frame counted; `left_out()` says how many frames (videos in
    the modes `sequence` and `frame_then_video`) `skip_empty` concerned, or have no pixel that is not ignored.
    """

    full_state_update = False
    is_differentiable = False
    higher_is_better = True
    sums: Tensor
    counts: Tensor

    def __init__(
        self,
        name: str,
        mode: Mode = "frame",
        skip_empty: bool = False,
        ignore_label: int | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        self.name, self.mode, self.skip_empty, self.ignore_label = name, mode, skip_empty, ignore_label
        self.add_state("sums", torch.zeros(2, dtype=torch.int64), dist_reduce_fx="sum")
        self.add_state("counts", torch.zeros(2, dtype=torch.int64), dist_reduce_fx="sum")

    def update(self, prediction: Labels, truth: Labels) -> None:
        """Adds a batch: identities and true labels, (B, T, H, W) integers >= 0."""
        table = contingency(prediction, truth, self.ignore_label)
        values = video_scores(table, self.name, self.mode, self.skip_empty).flatten()
        self.sums += encode_sum(values)
        self.counts += torch.stack([(~values.isnan()).sum(), values.isnan().sum()])

    def compute(self) -> Float64[Tensor, ""]:
        """The mean over everything added so far, by all processes."""
        return torch.tensor(decode_mean(self.sums, int(self.counts[0])), dtype=torch.float64, device=self.sums.device)

    def left_out(self) -> int:
        """How many values were left out, by all processes."""
        with self.sync_context():
            return int(self.counts[1])


class AdjustedRandIndex(SegmentationScore):
    """Mean ARI or ARI-FG; arguments as in `segmentation.ari`."""

    def __init__(self, foreground: bool = False, mode: Mode = "frame", skip_empty: bool = False, **kwargs: Any) -> None:
        super().__init__(ari_name(foreground), mode, skip_empty, **kwargs)


class SegmentationCovering(SegmentationScore):
    """Mean segmentation covering; arguments as in `segmentation.covering`."""

    def __init__(
        self,
        background: bool = True,
        scaled: bool = False,
        mode: Mode = "frame",
        skip_empty: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(covering_name(background, scaled), mode, skip_empty, **kwargs)


class SceneMetrics(Metric):
    """The paper's four segmentation numbers and their values per video, for training and evaluation loops.

    Args:
        names: which of `segmentation.SCORES`.
        skip_empty: leaves frames without any object out of the foreground means.
        ignore_label: pixels of this true label are left out.

    `compute()` has the mean over all frames of all videos per name; keeps one small row per video.
    """

    full_state_update = False
    is_differentiable = False
    sums: Tensor
    counts: Tensor
    frames: Tensor
    empty_frames: Tensor
    rows: list[Tensor]

    def __init__(
        self,
        names: Sequence[str] = PAPER_SCORES,
        skip_empty: bool = False,
        ignore_label: int | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        unknown = [name for name in names if name not in SCORES]
        if unknown:
            raise ValueError(f"there is no segmentation score {unknown[0]!r}; choose from {', '.join(SCORES)}")
        self.names, self.skip_empty, self.ignore_label = tuple(names), skip_empty, ignore_label
        self.add_state("sums", torch.zeros(len(names), 2, dtype=torch.int64), dist_reduce_fx="sum")
        self.add_state("counts", torch.zeros(len(names), dtype=torch.int64), dist_reduce_fx="sum")
        self.add_state("frames", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")
        self.add_state("empty_frames", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")
        self.add_state("rows", [], dist_reduce_fx="cat")

    def update(self, prediction: Labels, truth: Labels, index: Int64[Tensor, " B"] | None = None) -> None:
        """Adds a batch of videos.

        Args:
            prediction: identities (B, T, H, W), as `scene_identities` gives them.
            truth: true labels (B, T, H, W), 0 is the background.
            index: number of each video in its data set, for `per_video`; counted up from 0 where missing.
        """
        table = contingency(prediction, truth, self.ignore_label)
        values = self._values(table)
        self.sums += encode_sum(values.flatten(1))
        self.counts += (~values.isnan()).flatten(1).sum(dim=1)
        if index is None:
            first = sum(len(rows) for rows in self.rows)
            index = torch.arange(first, first + len(truth))
        frames = torch.full((len(truth),), truth.shape[1], dtype=torch.float64, device=values.device)
        empty = table.empty_frames.sum(dim=1)
        self.frames += truth.shape[0] * truth.shape[1]
        self.empty_frames += empty.sum()
        columns = [index.to(values), frames, empty.double(), *values.nanmean(dim=2)]
        self.rows.append(torch.stack(columns, dim=1))

    def compute(self) -> dict[str, float]:
        """Mean over all frames of all videos per name, by all processes; NaN before any frame counted."""
        counts = self.counts.tolist()
        return {name: decode_mean(sums, count) for name, sums, count in zip(self.names, self.sums, counts, strict=True)}

    def per_video(self) -> list[dict[str, int | float]]:
        """One row per video, by all processes, in the order of `index`: `index`, `frames`, `empty_frames`, means."""
        with self.sync_context():
            if self.frames == 0:
                return []
            rows = dim_zero_cat(self.rows).tolist()
        keys = ("index", "frames", "empty_frames")
        found = [dict(zip((*keys, *self.names), row, strict=True)) for row in sorted(rows, key=lambda row: row[0])]
        return [{key: int(value) if key in keys else value for key, value in row.items()} for row in found]

    def size(self) -> dict[str, int]:
        """How much was scored, by all processes: `videos`, `frames`, `empty_frames` (no object visible)."""
        with self.sync_context():
            videos = len(dim_zero_cat(self.rows)) if self.frames > 0 else 0
            return {"videos": videos, "frames": int(self.frames), "empty_frames": int(self.empty_frames)}

    def _values(self, table: Contingency) -> Float64[Tensor, "M B T"]:
        return torch.stack([video_scores(table, name, "frame", self.skip_empty) for name in self.names])
