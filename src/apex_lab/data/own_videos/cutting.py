"""Which clips are cut from which video, and which split each belongs to. Pure: reads no file."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

SPLITS = ("train", "val", "test")
FEW = 10
"""With fewer videos than this, every video is split by time: one or two whole videos would decide the scores."""

SplitBy = Literal["auto", "video", "time"]


@dataclass(frozen=True)
class Cut:
    """How videos are cut.

    Attributes:
        frames: of a clip.
        stride: every so many frames of the video one is taken.
        hop: frames of the video from the start of a clip to that of the next.
    """

    frames: int
    stride: int
    hop: int

    @property
    def span(self) -> int:
        """Frames of the video from a clip's first to its last, both included."""
        return (self.frames - 1) * self.stride + 1

    def starts(self, length: int) -> list[int]:
        """First frames of the clips of a video."""
        return list(range(0, length - self.span + 1, self.hop))


Start = tuple[int, int]
"""(video, first frame) of a clip."""


def split_by(wish: SplitBy, videos: int) -> Literal["video", "time"]:
    """What the splits are made by."""
    if wish != "auto":
        return wish
    return "time" if videos < FEW else "video"


def clips_by_video(
    digests: Sequence[str], lengths: Sequence[int], cut: Cut, shares: Mapping[str, float]
) -> dict[str, list[Start]]:
    """Every video belongs to one split; which one depends on its content, in an order that hashes decide.

    Args:
        digests: of the videos' contents.
        lengths: frames of the videos.
        cut: how.
        shares: of the videos for val and test; each gets one at least where there are three or more.
    """
    order = sorted(range(len(digests)), key=lambda video: hashlib.sha256(f"split {digests[video]}".encode()).digest())
    counts = {split: _count(shares[split], len(order)) for split in ("test", "val")}
    parts = {"test": order[: counts["test"]], "val": order[counts["test"] : counts["test"] + counts["val"]]}
    parts["train"] = order[counts["test"] + counts["val"] :]
    return {
        split: [(video, start) for video in sorted(parts[split]) for start in cut.starts(lengths[video])]
        for split in SPLITS
    }


def clips_by_time(lengths: Sequence[int], cut: Cut, shares: Mapping[str, float]) -> dict[str, list[Start]]:
    """Every video is split: first its clips for training, then those for val, then those for test.

    Clips that share a frame with the next split are left out.
    """
    starts = [cut.starts(length) for length in lengths]
    numbers = [len(each) for each in starts]
    total = sum(numbers)
    test = _shared_out(_count(shares["test"], total), numbers)
    rest = [number - taken for number, taken in zip(numbers, test, strict=True)]
    val = _shared_out(_count(shares["val"], total), rest)
    clips: dict[str, list[Start]] = {split: [] for split in SPLITS}
    for video, each in enumerate(starts):
        first_test = numbers[video] - test[video]
        first_val = first_test - val[video]
        parts = {"train": each[:first_val], "val": each[first_val:first_test], "test": each[first_test:]}
        limit = lengths[video]
        for split in ("test", "val", "train"):
            clips[split] += [(video, start) for start in parts[split] if start + cut.span <= limit]
            limit = parts[split][0] if parts[split] else limit
    return clips


def at_most(clips: Sequence[Start], limit: int) -> list[Start]:
    """`limit` of the clips, evenly spaced; all of them if they are fewer."""
    count = min(limit, len(clips))
    return [clips[position * len(clips) // count] for position in range(count)]


def _count(share: float, total: int) -> int:
    """A share of a total; one at least of three or more, if the share is above 0."""
    return max(round(share * total), 1 if total >= 3 and share > 0 else 0)


def _shared_out(count: int, numbers: Sequence[int]) -> list[int]:
    """`count` shared out in proportion to `numbers`, at most so many each, by largest remainders."""
    total = sum(numbers)
    if total == 0:
        return [0] * len(numbers)
    exact = [count * number / total for number in numbers]
    found = [int(part) for part in exact]
    order = sorted(range(len(numbers)), key=lambda i: (exact[i] - found[i], numbers[i], i), reverse=True)
    for i in order[: count - sum(found)]:
        found[i] += 1
    return found
