"""All metrics of one video, reduced to counts and small tables that add up over videos."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float64, Int64, Integer

from apex_lab.metrics.boundary import TOLERANCE, BoundaryScores, boundary_scores
from apex_lab.metrics.contingency import Contingency, contingency
from apex_lab.metrics.hota import HotaCounts
from apex_lab.metrics.identity import IdentityCounts
from apex_lab.metrics.ignored import ignored_pixels
from apex_lab.metrics.keys import KEYS, Number
from apex_lab.metrics.objects import ObjectMetadata, object_rows
from apex_lab.metrics.overlap import mean_best_overlap, mean_matched_iou
from apex_lab.metrics.segmentation import SCORES, video_scores
from apex_lab.metrics.tracking import Detections, Events, TrackingCounts, TrackingSettings, clear_events, detections


@dataclass(frozen=True)
class EvaluatorSettings:
    """How videos are scored; stored with the results.

    Attributes:
        tracking: frames, thresholds and treatment of the background for CLEAR MOT, IDF1 and HOTA.
        public_first_frame: CLEAR MOT and IDF1 are given once more from this frame on (the public protocol); None
            leaves that out.
        first_frame: segmentation is scored from this frame on, as if the video began there: every score of a frame or
            a volume, J and F. Tracking has `tracking.first_frame`; results per object are of all frames.
        skip_empty: leaves frames without any object out of the foreground means of ARI and covering.
        boundary_tolerance: for F, a share of the image diagonal.
        identities: `own` are the model's; `none` leaves out all that needs identities over time (NaN); `linked` takes
            segments of consecutive frames linked by overlap, an extra for models without identities.
        ignore_label: pixels of this true label are left out of every metric; None leaves none out.
        per_frame: keep a row per frame.
        events: keep the CLEAR MOT events.
    """

    tracking: TrackingSettings = field(default_factory=TrackingSettings)
    public_first_frame: int | None = 2
    first_frame: int = 0
    skip_empty: bool = False
    boundary_tolerance: float = TOLERANCE
    identities: Literal["own", "none", "linked"] = "own"
    ignore_label: int | None = None
    per_frame: bool = False
    events: bool = False

    def __post_init__(self) -> None:
        if self.identities not in ("own", "none", "linked"):
            raise ValueError(f"identities is {self.identities!r}; choose own, none or linked")
        if self.first_frame < 0:
            raise ValueError(f"first_frame is {self.first_frame}; frames are counted from 0")
        if not 0 < self.boundary_tolerance < 1:
            raise ValueError(f"boundary_tolerance is {self.boundary_tolerance}; it must lie in (0, 1)")
        self.protocols()

    def protocols(self) -> dict[str, TrackingSettings]:
        """Suffix of the keys -> what is evaluated under them."""
        found = {"": self.tracking}
        if self.public_first_frame is not None:
            public = asdict(self.tracking) | {"first_frame": self.public_first_frame}
            found[f"_start{self.public_first_frame}"] = TrackingSettings(**public)
        return found


@dataclass(frozen=True)
class TrackRecord:
    """What of one video needs identities over time.

    Attributes:
        volumes: name -> score of space-time volumes.
        clear, identity: suffix of the protocol -> counts.
        hota: counts.
        j, f: sums over objects, each the mean over its frames.
        objects: number of objects.
        events: frame, type, true label, identity, distance, where wanted; NaN where there is none.
    """

    volumes: dict[str, float]
    clear: dict[str, TrackingCounts]
    identity: dict[str, IdentityCounts]
    hota: HotaCounts
    j: float
    f: float
    objects: int
    events: Float64[np.ndarray, "N 5"]


@dataclass(frozen=True)
class VideoRecord:
    """What is kept of one video.

    Attributes:
        size: height and width.
        frames, empty_frames: how many, and how many of them without any visible object.
        scores: name -> sum of a frame score over the frames that have a value, and their number.
        tracks: None for models without identities.
        objects: `objects.object_rows`.
        rows: one per frame, where wanted.
    """

    size: tuple[int, int]
    frames: int
    empty_frames: int
    scores: dict[str, tuple[float, int]]
    tracks: TrackRecord | None
    objects: pd.DataFrame
    rows: list[dict[str, Number]]


@dataclass(frozen=True)
class _Table:
    """The contingency table of the one video at hand."""

    batch: Contingency
    counts: Int64[np.ndarray, "T G P"]
    labels: Int64[np.ndarray, " G"]
    ids: Int64[np.ndarray, " P"]


def score_video(
    prediction: Integer[np.ndarray, "T H W"],
    truth: Integer[np.ndarray, "T H W"],
    settings: EvaluatorSettings,
    metadata: ObjectMetadata | None = None,
    background_ids: Collection[int] = (),
) -> VideoRecord:
    """Scores one video; arguments as in `Evaluator.add`, identities as they are."""
    prediction, truth = (np.ascontiguousarray(labels).astype(np.int64) for labels in (prediction, truth))
    table = _table(prediction, truth, settings.ignore_label)
    columns = _frame_scores(table, settings.skip_empty)
    for values in columns.values():
        values[: settings.first_frame] = np.nan
    pixels = truth.shape[1] * truth.shape[2]
    scores = {name: _sum_and_count(values) for name, values in columns.items()}
    if settings.identities == "none":
        tracks = None
        objects = object_rows(table.counts, table.labels, metadata, pixels=pixels)
    else:
        kept = np.flatnonzero(np.isin(table.ids, list(background_ids))).tolist()
        frames = {name: detections(table.counts, protocol, kept) for name, protocol in settings.protocols().items()}
        events = {name: clear_events(frames[name], p.min_iou) for name, p in settings.protocols().items()}
        boundary = _boundary(prediction, truth, table, settings)
        cut = (table, boundary) if not settings.first_frame else _cut(prediction, truth, settings)
        tracks = _track_record(table, cut, settings, frames, events)
        objects = object_rows(table.counts, table.labels, metadata, boundary, frames[""], events[""], pixels)
        if settings.per_frame:
            columns |= _boundary_columns(cut[1] if cut else None, len(truth))
            columns |= _tracking_columns(frames[""], events[""], len(truth))
    return VideoRecord(
        size=(truth.shape[1], truth.shape[2]),
        frames=len(truth),
        empty_frames=int(table.batch.empty_frames.sum()),
        scores=scores,
        tracks=tracks,
        objects=objects,
        rows=_rows(columns, len(truth)) if settings.per_frame else [],
    )


def tracking_values(clear: TrackingCounts, identity: IdentityCounts, suffix: str = "") -> dict[str, Number]:
    """Rates, IDF1 and counts under the keys of an evaluation."""
    values = clear.rates() | {"idf1": identity.idf1()} | asdict(clear)
    return {name + suffix: value for name, value in values.items()}


def _frame_scores(table: _Table, skip_empty: bool) -> dict[str, Float64[np.ndarray, " T"]]:
    scores = {name: video_scores(table.batch, name, "frame", skip_empty)[0].numpy() for name in SCORES}
    scores["mbo"] = np.array([mean_best_overlap(frame) for frame in table.counts])
    scores["miou"] = np.array([mean_matched_iou(frame) for frame in table.counts])
    return scores


def _table(
    prediction: Int64[np.ndarray, "T H W"], truth: Int64[np.ndarray, "T H W"], ignore_label: int | None
) -> _Table:
    with _one_thread():
        batch = contingency(torch.from_numpy(prediction)[None], torch.from_numpy(truth)[None], ignore_label)
    return _Table(batch, batch.counts[0].numpy(), batch.labels[0].numpy(), batch.ids[0].numpy())


def _volume_scores(table: _Table | None, skip_empty: bool) -> dict[str, float]:
    if table is None:
        return dict.fromkeys((f"video_{name}" for name in (*SCORES, "mbo", "miou")), math.nan)
    scores = {f"video_{name}": float(video_scores(table.batch, name, "sequence", skip_empty)) for name in SCORES}
    volume = table.counts.sum(axis=0)
    return scores | {"video_mbo": mean_best_overlap(volume), "video_miou": mean_matched_iou(volume)}


def _cut(
    prediction: Int64[np.ndarray, "T H W"], truth: Int64[np.ndarray, "T H W"], settings: EvaluatorSettings
) -> tuple[_Table, BoundaryScores] | None:
    """Table and boundaries of the frames from which on segmentation is scored, as if they were the whole video; None
    where it ends before them.
    """
    prediction, truth = prediction[settings.first_frame :], truth[settings.first_frame :]
    if not len(truth):
        return None
    table = _table(prediction, truth, settings.ignore_label)
    return table, _boundary(prediction, truth, table, settings)


def _boundary(
    prediction: Int64[np.ndarray, "T H W"],
    truth: Int64[np.ndarray, "T H W"],
    table: _Table,
    settings: EvaluatorSettings,
) -> BoundaryScores:
    ignored = ignored_pixels(truth, settings.ignore_label)
    tolerance = settings.boundary_tolerance
    return boundary_scores(prediction, truth, table.counts, table.labels, table.ids, tolerance, ignored)


def _track_record(
    table: _Table,
    cut: tuple[_Table, BoundaryScores] | None,
    settings: EvaluatorSettings,
    frames: dict[str, list[Detections]],
    events: dict[str, Events],
) -> TrackRecord:
    shape = (len(table.labels), len(table.ids))
    j, f = (cut[1].j, cut[1].f) if cut else (np.empty((0, 1)), np.empty((0, 1)))
    protocols = settings.protocols().items()
    return TrackRecord(
        volumes=_volume_scores(cut[0] if cut else None, settings.skip_empty),
        clear={name: TrackingCounts.of_video(frames[name], events[name], p.tracked_share) for name, p in protocols},
        identity={name: IdentityCounts.of_video(frames[name], shape, p.min_iou) for name, p in protocols},
        hota=HotaCounts.of_video(frames[""], shape),
        j=math.fsum(np.nanmean(j, axis=1)),
        f=math.fsum(np.nanmean(f, axis=1)),
        objects=len(j),
        events=_event_table(events[""], table) if settings.events else np.empty((0, 5)),
    )


def _event_table(events: Events, table: _Table) -> Float64[np.ndarray, "N 5"]:
    """Rows and columns of the table replaced by labels and identities."""
    label = np.where(events.row < 0, np.nan, table.labels[events.row])
    identity = np.where(events.column < 0, np.nan, table.ids[events.column])
    return np.column_stack([events.frame, events.type, label, identity, events.distance])


def _boundary_columns(boundary: BoundaryScores | None, n_frames: int) -> dict[str, Float64[np.ndarray, " T"]]:
    """J and F per frame; NaN in frames before the first that is scored."""
    if boundary is None or not len(boundary.j):
        return {}
    missing = np.full(n_frames - boundary.j.shape[1], np.nan)
    j, f = (np.concatenate([missing, values.mean(axis=0)]) for values in (boundary.j, boundary.f))
    return {"j": j, "f": f, "jf": (j + f) / 2}


def _tracking_columns(
    frames: Sequence[Detections], events: Events, n_frames: int
) -> dict[str, Float64[np.ndarray, " T"]]:
    """Tracking values per frame; NaN in frames that are not evaluated."""
    columns: dict[str, Float64[np.ndarray, " T"]] = {}
    for found in frames:
        here = events.frame == found.frame
        part = Events(*(getattr(events, name)[here] for name in ("frame", "type", "row", "column", "distance")))
        counts = TrackingCounts.of_video([found], part)
        for name, value in (counts.rates() | asdict(counts)).items():
            columns.setdefault(name, np.full(n_frames, np.nan))[found.frame] = value
    return columns


def _rows(columns: dict[str, Float64[np.ndarray, " T"]], n_frames: int) -> list[dict[str, Number]]:
    def value(name: str, frame: int) -> Number:
        number = float(columns[name][frame]) if name in columns else math.nan
        return int(number) if name.startswith("num_") and not math.isnan(number) else number

    names = [name for name, key in KEYS.items() if "frame" in key.levels]
    return [{"frame": t} | {name: value(name, t) for name in names} for t in range(n_frames)]


@contextmanager
def _one_thread() -> Iterator[None]:
    """One video is a millisecond's work: threads gain nothing, and wait for each other where cores are shared."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _sum_and_count(values: Float64[np.ndarray, " T"]) -> tuple[float, int]:
    known: Any = values[~np.isnan(values)]
    return math.fsum(known), len(known)
