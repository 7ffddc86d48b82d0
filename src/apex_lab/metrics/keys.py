"""The name, meaning, range and direction of every number that an evaluation writes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

VALIDATION_SCORES = ("ari_fg", "msc_fg", "ari", "msc", "mota", "match")
"""Scores that validation puts into the curves; those of tracking only for models that track."""

Level = Literal["frame", "video", "total"]
Number = int | float
_ALL: tuple[Level, ...] = ("frame", "video", "total")
_LONG: tuple[Level, ...] = ("video", "total")


@dataclass(frozen=True)
class Key:
    """What stands under one name.

    Attributes:
        meaning: one sentence.
        range: in words; "count" for counts.
        better: which direction is good; None where there is none.
        levels: where it is given: per frame, per video, in total.
    """

    meaning: str
    range: str
    better: Literal["up", "down"] | None
    levels: tuple[Level, ...]


_SHARE, _PERCENT, _COUNT, _RAND = "0 to 1", "0 to 100 percent", "count", "at most 1, 0 for chance"
_FRAMES = "; a video's value is the mean over its frames, the total the mean over all frames of all videos"

_SEGMENTATION = {
    "ari": Key(f"Adjusted Rand index over all pixels of a frame{_FRAMES}.", _RAND, "up", _ALL),
    "ari_fg": Key("The same over the pixels of true objects; 1 in a frame without any.", _RAND, "up", _ALL),
    "msc": Key(f"Segmentation covering, each true region (background too) one vote{_FRAMES}.", _SHARE, "up", _ALL),
    "msc_fg": Key("The same over objects alone; 0 in a frame without any.", _SHARE, "up", _ALL),
    "sc": Key("Segmentation covering, true regions weighted by area.", _SHARE, "up", _ALL),
    "sc_fg": Key("The same over objects alone; 0 in a frame without any.", _SHARE, "up", _ALL),
    "mbo": Key("Mean best overlap of the objects of a frame; frames without any left out.", _SHARE, "up", _ALL),
    "miou": Key(
        "Mean IoU under a one-to-one assignment in the frame; frames without any left out.", _SHARE, "up", _ALL
    ),
}

_VIDEO = {
    "video_ari": Key("ARI with a whole video as one point set, identities as labels.", _RAND, "up", _LONG),
    "video_ari_fg": Key("The same over the pixels of true objects; 1 without any.", _RAND, "up", _LONG),
    "video_msc": Key("Unscaled covering of space-time volumes, background too.", _SHARE, "up", _LONG),
    "video_msc_fg": Key("The same over objects alone; 0 without any.", _SHARE, "up", _LONG),
    "video_sc": Key("Covering of space-time volumes weighted by size.", _SHARE, "up", _LONG),
    "video_sc_fg": Key("The same over objects alone; 0 without any.", _SHARE, "up", _LONG),
    "video_mbo": Key("Mean best overlap of space-time volumes; videos without objects left out.", _SHARE, "up", _LONG),
    "video_miou": Key("Mean IoU of volumes under a one-to-one assignment; likewise.", _SHARE, "up", _LONG),
    "j": Key("Region similarity (DAVIS), mean over objects and frames.", _SHARE, "up", _ALL),
    "f": Key("Boundary measure (DAVIS), mean over objects and frames.", _SHARE, "up", _ALL),
    "jf": Key("Mean of j and f.", _SHARE, "up", _ALL),
}

_HOTA = {
    "hota": Key("HOTA, mean over the thresholds 0.05 to 0.95.", _SHARE, "up", _LONG),
    "deta": Key("Its detection accuracy.", _SHARE, "up", _LONG),
    "assa": Key("Its association accuracy.", _SHARE, "up", _LONG),
    "detre": Key("Its detection recall.", _SHARE, "up", _LONG),
    "detpr": Key("Its detection precision.", _SHARE, "up", _LONG),
    "assre": Key("Its association recall.", _SHARE, "up", _LONG),
    "asspr": Key("Its association precision.", _SHARE, "up", _LONG),
    "loca": Key("Mean IoU of its true positives; 1 by convention where there are none.", _SHARE, "up", _LONG),
    "hota0": Key("HOTA at the threshold 0.05.", _SHARE, "up", _LONG),
}

_TRACKING = {
    "mota": Key("100 (1 - (misses + switches + false positives) / N).", "at most 100 percent", "up", _ALL),
    "motp": Key("Mean IoU of matched pairs.", "50 to 100 percent", "up", _ALL),
    "match": Key("Matches without switches, of N.", _PERCENT, "up", _ALL),
    "id_switches": Key("Identity switches, of N.", _PERCENT, "down", _ALL),
    "fps": Key("False positives, of N.", "at least 0 percent, can exceed 100", "down", _ALL),
    "misses": Key("Misses, of N.", _PERCENT, "down", _ALL),
    "md": Key("Mostly detected: objects matched in at least 80 % of their frames.", _PERCENT, "up", _LONG),
    "mt": Key("Mostly tracked: the same without counting switches.", _PERCENT, "up", _LONG),
    "idf1": Key("IDF1: F1 of identities under the best assignment of tracks.", _SHARE, "up", _LONG),
    "num_frames": Key("Evaluated frames.", _COUNT, None, _LONG),
    "num_objects": Key("N: occurrences of true objects.", _COUNT, None, _ALL),
    "num_matches": Key("Matches without switches.", _COUNT, "up", _ALL),
    "num_switches": Key("Matches under another identity than at the last match.", _COUNT, "down", _ALL),
    "num_misses": Key("True objects without a match.", _COUNT, "down", _ALL),
    "num_false_positives": Key("Predictions without a match.", _COUNT, "down", _ALL),
    "num_unique_objects": Key("Distinct true objects.", _COUNT, None, _LONG),
    "num_mostly_detected": Key("Of those, mostly detected.", _COUNT, "up", _LONG),
    "num_mostly_tracked": Key("Of those, mostly tracked.", _COUNT, "up", _LONG),
    "sum_distance": Key("Sum of 1 - IoU over matches and switches.", "at least 0", "down", _ALL),
}

_SIZES = {
    "videos": Key("Videos.", _COUNT, None, ("total",)),
    "frames": Key("Frames.", _COUNT, None, _LONG),
    "empty_frames": Key("Frames in which no object is visible.", _COUNT, None, _LONG),
}

FRAME_SCORES = ("ari", "ari_fg", "msc", "msc_fg", "sc", "sc_fg", "mbo", "miou")
"""Scores of single frames; all others need identities over time."""

VIDEO_SCORES = tuple(f"video_{name}" for name in FRAME_SCORES)
"""Scores of space-time volumes."""


def keys(public_first_frame: int | None = 2) -> dict[str, Key]:
    """Every key an evaluation with this setting writes, in order; undefined values are NaN (null in JSON).

    Keys that end in `_start2` are the tracking values of the public protocol, which leaves the first two frames out.
    """
    found = _SIZES | _SEGMENTATION | _VIDEO | _HOTA | _TRACKING
    if public_first_frame is not None:
        for name, key in _TRACKING.items():
            meaning = f"`{name}` from frame {public_first_frame} on (the public protocol of Weis et al. starts at 2)."
            levels = tuple(level for level in key.levels if level != "frame")
            found[f"{name}_start{public_first_frame}"] = Key(meaning, key.range, key.better, levels)
    return found


KEYS = keys()
"""Every key of an evaluation with default settings."""
