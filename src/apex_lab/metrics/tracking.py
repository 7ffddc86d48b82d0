"""Multi-object tracking after Weis et al. (JMLR 2021) with motmetrics as the engine (metrics.md section 2).

Mask IoU instead of box distance, CLEAR MOT events of Bernardin and Stiefelhagen (2008), MD and MT with the shares of
frames in which an object is matched at all, and matched under its last identity. What differs from the public
program on purpose: masks are compared as arrays of known size, the background is found by its label and not by its
place in a list, and identities cannot meet across videos, because each video has its own accumulator; counts of
videos are then added up, which is the same as one accumulator over all videos with identities made unique.

MD can never be smaller than MT. In the paper's table it is, in every row, so its two column titles are evidently
exchanged: our MD is to be compared with the column that the paper calls MT, and the reverse.

Legend: T frames, G true regions (row 0 is the background), P predicted identities, n and m those left in a frame.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import motmetrics
import numpy as np
from jaxtyping import Float64, Int64

from apex_lab.metrics.contingency import BACKGROUND

EVENT_TYPES = ("FP", "MISS", "SWITCH", "MATCH")


@dataclass(frozen=True)
class TrackingSettings:
    """What is evaluated, stored with every result.

    Attributes:
        first_frame: frames before it are left out (2 in the public program, a burn-in).
        stop_frame: up to, not including; None is the end of the video (10 in the public program, as long as its
            videos).
        min_iou: a pair with a smaller IoU is no match; exactly this IoU is one.
        min_pixels: true and predicted masks with so many pixels or fewer are dropped, frame by frame.
        background_iou: predictions with a larger IoU with the true background are removed from the frame; None
            removes none.
        tracked_share: an object found in at least this share of its frames counts in MD (and MT).
        drop_background_slot: take the predicted background out first, by identity; without it only `background_iou`
            removes it, the same rule for all models.
    """

    first_frame: int = 0
    stop_frame: int | None = None
    min_iou: float = 0.5
    min_pixels: int = 5
    background_iou: float | None = 0.2
    tracked_share: float = 0.8
    drop_background_slot: bool = False

    def __post_init__(self) -> None:
        if self.first_frame < 0 or (self.stop_frame is not None and self.stop_frame <= self.first_frame):
            raise ValueError(
                f"first_frame is {self.first_frame} and stop_frame {self.stop_frame}; "
                "want 0 <= first_frame < stop_frame"
            )
        for name in ("min_iou", "tracked_share"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must lie in (0, 1]")
        if self.background_iou is not None and not 0 <= self.background_iou <= 1:
            raise ValueError(f"background_iou is {self.background_iou}; it must lie in [0, 1] or be None")
        if self.min_pixels < 0:
            raise ValueError(f"min_pixels is {self.min_pixels}; it must be at least 0")


@dataclass(frozen=True)
class Detections:
    """What of one frame takes part in tracking.

    Attributes:
        frame: its number in the video.
        rows: the true objects, as rows of the video's contingency table.
        columns: the predictions, as columns of that table.
        iou: their mask IoU.
    """

    frame: int
    rows: Int64[np.ndarray, " n"]
    columns: Int64[np.ndarray, " m"]
    iou: Float64[np.ndarray, "n m"]


def detections(
    counts: Int64[np.ndarray, "T G P"], settings: TrackingSettings, background_columns: Sequence[int] = ()
) -> list[Detections]:
    """Drops small masks and the background from every evaluated frame (metrics.md section 2, steps 2 to 5).

    Args:
        counts: contingency table of one video.
        settings: what to evaluate.
        background_columns: the model's own background, looked at with `drop_background_slot` alone.
    """
    true_area, found_area = counts.sum(axis=2), counts.sum(axis=1)
    iou = counts / np.maximum(true_area[:, :, None] + found_area[:, None, :] - counts, 1)
    true_kept, found_kept = true_area > settings.min_pixels, found_area > settings.min_pixels
    if settings.drop_background_slot:
        found_kept[:, list(background_columns)] = False
    if settings.background_iou is not None:
        is_background = true_kept[:, BACKGROUND, None] & (iou[:, BACKGROUND] > settings.background_iou)
        found_kept &= ~is_background
    true_kept[:, BACKGROUND] = False
    frames = range(len(counts))[settings.first_frame : settings.stop_frame]
    left = ((t, np.flatnonzero(true_kept[t]), np.flatnonzero(found_kept[t])) for t in frames)
    return [Detections(t, rows, columns, iou[t][np.ix_(rows, columns)]) for t, rows, columns in left]


@dataclass(frozen=True)
class Events:
    """CLEAR MOT events of one video, N in all.

    Attributes:
        frame: number in the video.
        type: index into `EVENT_TYPES`, counted from 1.
        row: the true object, as a row of the contingency table; -1 for FP.
        column: the predicted identity, as a column; -1 for MISS.
        distance: 1 - IoU; NaN for FP and MISS.
    """

    frame: Int64[np.ndarray, " N"]
    type: Int64[np.ndarray, " N"]
    row: Int64[np.ndarray, " N"]
    column: Int64[np.ndarray, " N"]
    distance: Float64[np.ndarray, " N"]

    def of(self, *names: str) -> np.ndarray:
        """Which events are of these types, (N,) bool."""
        return np.isin(self.type, [EVENT_TYPES.index(name) + 1 for name in names])


def clear_events(frames: Iterable[Detections], min_iou: float = 0.5) -> Events:
    """Matches true objects and predictions frame by frame (metrics.md section 2, steps 6 and 7).

    Rows and columns of the table stand for identities, small numbers that motmetrics' float64 holds exactly.
    """
    accumulator = motmetrics.MOTAccumulator()
    # motmetrics would silently prefer another solver where one is installed.
    with motmetrics.lap.set_default_solver("scipy"):
        for found in frames:
            distance = np.where(found.iou >= min_iou, 1.0 - found.iou, np.nan)
            accumulator.update(found.rows, found.columns, distance, frameid=found.frame)
    table = accumulator.mot_events.reset_index()
    # TRANSFER, ASCEND and MIGRATE are further rows for a pair that has its event already.
    table = table[table.Type.isin(EVENT_TYPES)]
    return Events(
        frame=table.FrameId.to_numpy(dtype=np.int64),
        type=table.Type.map({name: i + 1 for i, name in enumerate(EVENT_TYPES)}).to_numpy(dtype=np.int64),
        row=table.OId.fillna(-1).to_numpy(dtype=np.int64),
        column=table.HId.fillna(-1).to_numpy(dtype=np.int64),
        distance=table.D.to_numpy(dtype=np.float64),
    )


@dataclass(frozen=True)
class TrackingCounts:
    """What happened in one video, or in many together.

    Attributes:
        num_frames: evaluated frames.
        num_objects: occurrences of true objects (N).
        num_matches, num_switches, num_misses, num_false_positives: events.
        num_unique_objects: distinct true objects (O).
        num_mostly_detected, num_mostly_tracked: of those, with enough matches at all, and without switches.
        sum_distance: sum of 1 - IoU over matches and switches.
    """

    num_frames: int
    num_objects: int
    num_matches: int
    num_switches: int
    num_misses: int
    num_false_positives: int
    num_unique_objects: int
    num_mostly_detected: int
    num_mostly_tracked: int
    sum_distance: float

    @staticmethod
    def of_video(frames: Sequence[Detections], events: Events, tracked_share: float = 0.8) -> TrackingCounts:
        """Counts the events of one video (metrics.md section 2.1)."""
        objects, occurrences = np.unique(np.concatenate([[], *(f.rows for f in frames)]), return_counts=True)
        matched, switched = events.of("MATCH"), events.of("SWITCH")

        def share(rows: np.ndarray) -> np.ndarray:
            return (rows[:, None] == objects).sum(axis=0) / occurrences

        return TrackingCounts(
            num_frames=len(frames),
            num_objects=int(occurrences.sum()),
            num_matches=int(matched.sum()),
            num_switches=int(switched.sum()),
            num_misses=int(events.of("MISS").sum()),
            num_false_positives=int(events.of("FP").sum()),
            num_unique_objects=len(objects),
            num_mostly_detected=int((share(events.row[matched | switched]) >= tracked_share).sum()),
            num_mostly_tracked=int((share(events.row[matched]) >= tracked_share).sum()),
            sum_distance=math.fsum(events.distance[matched | switched]),
        )

    @staticmethod
    def total(videos: Iterable[TrackingCounts]) -> TrackingCounts:
        """All videos together; their order changes no digit."""
        rows = [dataclasses.asdict(video) for video in videos]
        names = [field.name for field in dataclasses.fields(TrackingCounts) if field.name != "sum_distance"]
        counts = {name: sum(row[name] for row in rows) for name in names}
        return TrackingCounts(**counts, sum_distance=math.fsum(row["sum_distance"] for row in rows))

    def rates(self) -> dict[str, float]:
        """The table's columns in percent, `mota motp match id_switches fps misses md mt`.

        NaN where the definition divides by zero: no true object (all but MOTP), no match (MOTP).

        Raises:
            AssertionError: the counts contradict each other; this is a fault of the evaluation itself.
        """
        n, matched = self.num_objects, self.num_matches + self.num_switches
        rates = {
            "mota": _percent(n - self.num_misses - self.num_switches - self.num_false_positives, n),
            "motp": _percent(matched - self.sum_distance, matched),
            "match": _percent(self.num_matches, n),
            "id_switches": _percent(self.num_switches, n),
            "fps": _percent(self.num_false_positives, n),
            "misses": _percent(self.num_misses, n),
            "md": _percent(self.num_mostly_detected, self.num_unique_objects),
            "mt": _percent(self.num_mostly_tracked, self.num_unique_objects),
        }
        if matched + self.num_misses != n:
            raise AssertionError(f"Match + ID S. + Miss is not 100 percent: {self}")
        if n and not math.isclose(rates["mota"], rates["match"] - rates["fps"], rel_tol=1e-9, abs_tol=1e-9):
            raise AssertionError(f"MOTA is not Match - FPs: {self}")
        if self.num_mostly_detected < self.num_mostly_tracked:
            raise AssertionError(f"MD is smaller than MT: {self}")
        return rates


def _percent(part: int | float, whole: int) -> float:
    return 100 * part / whole if whole else math.nan
