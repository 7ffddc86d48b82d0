"""Every metric of many videos, one video at a time: what `evaluate` and the scoring of prediction files stand on."""

from __future__ import annotations

import importlib.metadata
import math
import platform
from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float64, Integer

from apex_lab.base.order import natural_key
from apex_lab.metrics.hota import ALPHAS, HotaCounts
from apex_lab.metrics.identity import IdentityCounts
from apex_lab.metrics.ignored import ignored_pixels
from apex_lab.metrics.keys import FRAME_SCORES, VIDEO_SCORES, Number, keys
from apex_lab.metrics.linking import link_frames
from apex_lab.metrics.objects import COLUMNS, ObjectMetadata
from apex_lab.metrics.tracking import EVENT_TYPES, TrackingCounts
from apex_lab.metrics.video_record import EvaluatorSettings, VideoRecord, score_video, tracking_values

MAX_IDENTITY = 2**53
"""Readers of JSON keep numbers as float64, which is exact up to here."""


class Evaluator:
    """Scores videos one at a time and keeps small records of them; the order of videos changes no digit.

    Evaluators can be pickled and merged, so parts of a data set can be scored by different processes.

    Args:
        settings: how to score.

    Example:
        >>> evaluator = Evaluator()
        >>> evaluator.add("test_00000", identities, segmentation)
        >>> evaluator.result()["total"]["ari_fg"]
    """

    def __init__(self, settings: EvaluatorSettings | None = None) -> None:
        self.settings = settings or EvaluatorSettings()
        self.records: dict[str, VideoRecord] = {}

    def add(
        self,
        name: str,
        prediction: Integer[np.ndarray, "T H W"],
        truth: Integer[np.ndarray, "T H W"],
        metadata: ObjectMetadata | None = None,
        background_ids: Collection[int] | None = None,
    ) -> VideoRecord:
        """Scores one video.

        Args:
            name: unique among the videos.
            prediction: identity of the winning component at every pixel, 0 <= identity <= 2^53.
            truth: true labels, >= 0, or `EvaluatorSettings.ignore_label`; 0 is the background.
            metadata: of the true objects, for the results per object.
            background_ids: which identities are the model's background; needed with `drop_background_slot` alone.

        Raises:
            ValueError: the name was there before, or label maps that cannot be read; see `contingency`.
        """
        if name in self.records:
            raise ValueError(f"video {name!r} was scored before; every video needs a name of its own")
        if np.max(prediction, initial=0) > MAX_IDENTITY:
            raise ValueError(f"video {name!r} has the identity {np.max(prediction)}; identities end at 2^53")
        if self.settings.identities == "linked":
            prediction = link_frames(prediction, ignored_pixels(truth, self.settings.ignore_label))
            background_ids = ()
        elif self.settings.tracking.drop_background_slot and background_ids is None:
            raise ValueError(
                f"drop_background_slot is set, but which identities of video {name!r} are background is not known"
            )
        self.records[name] = score_video(prediction, truth, self.settings, metadata, background_ids or ())
        return self.records[name]

    def merge(self, other: Evaluator) -> None:
        """Takes over the videos of another evaluator.

        Raises:
            ValueError: other settings, or a video that both have scored.
        """
        if other.settings != self.settings:
            raise ValueError(f"evaluators with different settings cannot be merged: {self.settings}, {other.settings}")
        twice = sorted(self.records.keys() & other.records.keys())
        if twice:
            raise ValueError(f"video {twice[0]!r} was scored by both evaluators")
        self.records.update(other.records)

    def result(self) -> dict[str, Any]:
        """Everything, with videos in the natural order of their names (v2 before v10).

        Returns:
            `settings`; `versions`; `total` and `per_video` with the keys of `keys.KEYS`; `per_frame`, where wanted;
            `per_object`, a table (`objects.object_rows`); `hota_alpha`, HOTA per threshold; `events`, where wanted,
            a dict per event.
        """
        records = {name: self.records[name] for name in sorted(self.records, key=natural_key)}
        per_video = [self._row([record]) for record in records.values()]
        found: dict[str, Any] = {
            "settings": asdict(self.settings),
            "versions": versions(),
            "total": {"videos": len(records)} | self._row(list(records.values())),
            "per_video": [{"video": name} | row for name, row in zip(records, per_video, strict=True)],
            "per_object": _object_table(records),
            "hota_alpha": {
                "alpha": ALPHAS.tolist(),
                "total": _hota(records.values()).curves()["hota"].tolist(),
                "per_video": {name: _hota([record]).curves()["hota"].tolist() for name, record in records.items()},
            },
        }
        if self.settings.per_frame:
            found["per_frame"] = [{"video": name} | row for name, record in records.items() for row in record.rows]
        if self.settings.events:
            found["events"] = {
                name: _event_rows(record.tracks.events) if record.tracks else [] for name, record in records.items()
            }
        return found

    def _row(self, records: Sequence[VideoRecord]) -> dict[str, Number]:
        """The values of some videos together."""
        tracks = [record.tracks for record in records if record.tracks]
        row: dict[str, Number] = {
            "frames": sum(record.frames for record in records),
            "empty_frames": sum(record.empty_frames for record in records),
        }
        for name in FRAME_SCORES:
            sums, counts = zip(*(record.scores[name] for record in records), strict=True) if records else ((), ())
            row[name] = _ratio(math.fsum(sums), sum(counts))
        for name in VIDEO_SCORES:
            known = [track.volumes[name] for track in tracks if not math.isnan(track.volumes[name])]
            row[name] = _ratio(math.fsum(known), len(known))
        objects = sum(track.objects for track in tracks)
        row["j"] = _ratio(math.fsum(track.j for track in tracks), objects)
        row["f"] = _ratio(math.fsum(track.f for track in tracks), objects)
        row["jf"] = (row["j"] + row["f"]) / 2
        row |= _hota(records).means()
        for suffix in self.settings.protocols():
            clear = TrackingCounts.total(track.clear[suffix] for track in tracks)
            identity = IdentityCounts.total(track.identity[suffix] for track in tracks)
            row |= tracking_values(clear, identity, suffix)
        return {name: row[name] for name in keys(self.settings.public_first_frame) if name in row}


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    names = ("apex-lab", "torch", "torchmetrics", "numpy", "scipy", "pandas", "motmetrics")
    return {"python": platform.python_version()} | {name: importlib.metadata.version(name) for name in names}


def _ratio(total: float, count: int) -> float:
    return total / count if count else math.nan


def _hota(records: Iterable[VideoRecord]) -> HotaCounts:
    return HotaCounts.total(record.tracks.hota for record in records if record.tracks)


def _object_table(records: dict[str, VideoRecord]) -> pd.DataFrame:
    """The objects of all videos, with the column `video` first."""
    parts = [record.objects.assign(video=name) for name, record in records.items() if len(record.objects)]
    table = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=["video", *COLUMNS])
    return table[["video", *COLUMNS]]


def _event_rows(events: Float64[np.ndarray, "N 5"]) -> list[dict[str, Any]]:
    """None where an event has no true label, identity or distance."""
    return [
        {
            "frame": int(frame),
            "type": EVENT_TYPES[int(kind) - 1],
            "label": None if math.isnan(label) else int(label),
            "id": None if math.isnan(identity) else int(identity),
            "distance": None if math.isnan(distance) else distance,
        }
        for frame, kind, label, identity, distance in events.tolist()
    ]
