"""What a recording of own videos holds, and how its clips are read, in the worker processes of the store."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from apex_lab.base.errors import UserError
from apex_lab.data.own_videos import cutting
from apex_lab.data.own_videos.cutting import SPLITS, Cut, Start
from apex_lab.videos import Fit, Frame, framing, open_video
from recordings import Facts, Field, Item, Kind, Layout, Maker, Plan, RecordingError

VERSION = 1
"""Raised when the same videos and settings give other pixels or other splits."""

Settings = dict[str, Any]
"""`videos` (name, digest and frames of each), `frames`, `image_size`, `stride`, `hop`, `fit`, `split_by` ("video" or
"time"), `val_share`, `test_share`, and `train`, `val`, `test`, the most clips of each."""

KIND: Kind[Settings] = Kind(
    "own_videos",
    make_command="python -m apex_lab.train data=video data.path=FOLDER",
    repair_command="python -m apex_lab.data.own_videos verify {root} --repair",
    version=VERSION,
    item="clip",
    items="clips",
    notes=("name", "video", "start"),
    about="Clips of videos without labels. The notes of a clip in `manifest.json` name its video and its first frame.",
)


def cut_of(settings: Settings) -> Cut:
    """How the videos are cut."""
    return Cut(settings["frames"], settings["stride"], settings["hop"])


def clips_of(settings: Settings) -> dict[str, list[Start]]:
    """The clips of every split: a function of the settings alone."""
    videos = settings["videos"]
    lengths, shares = [video["frames"] for video in videos], {s: settings[f"{s}_share"] for s in ("val", "test")}
    if settings["split_by"] == "video":
        found = cutting.clips_by_video([video["digest"] for video in videos], lengths, cut_of(settings), shares)
    else:
        found = cutting.clips_by_time(lengths, cut_of(settings), shares)
    return {split: cutting.at_most(found[split], settings[split]) for split in SPLITS}


def plan_of(settings: Settings) -> Plan[Settings]:
    """What a folder with these settings holds."""
    sizes = {"T": settings["frames"], "S": settings["image_size"]}
    fields = {"rgb": Field("|u1", ("T", "S", "S", 3), "frames")}
    return Plan(KIND, settings, Layout(fields, {split: len(each) for split, each in clips_of(settings).items()}, sizes))


@dataclass(frozen=True)
class ClipMaker(Maker):
    """Makes the clips of some videos.

    Attributes:
        settings: of the recording.
        sources: where the videos are, in the order of the settings.
        about: further facts.
    """

    settings: Settings
    sources: Sequence[str]
    about: Facts

    @cached_property
    def clips(self) -> dict[str, list[Start]]:
        """The clips of every split."""
        return clips_of(self.settings)

    def facts(self) -> Facts:
        """The decoder's version, and what else is known."""
        return {"versions": {"opencv": cv2.__version__}, **self.about}

    def make(self, split: str, index: int) -> Item:
        """Reads one clip."""
        settings, cut = self.settings, cut_of(self.settings)
        video, start = self.clips[split][index]
        source, name = self.sources[video], settings["videos"][video]["name"]
        try:
            stream = _stream(source, settings["image_size"], settings["fit"], cut.span)
            frames = stream.read(start, cut.span)
        except (UserError, OSError) as error:
            raise RecordingError(str(error)) from error
        if len(frames) < cut.span:
            raise RecordingError(
                f"{source} ended before frame {start + cut.span - 1}, which it had when it was looked at: "
                "leave the videos alone and run the same command again"
            )
        notes = {"name": clip_name(name, start), "video": name, "start": start}
        return Item({"rgb": np.stack(frames[:: cut.stride])}, notes)


def clip_name(video: str, start: int) -> str:
    """Name of a clip: that of its video, fit for files, and its first frame."""
    plain = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in video)
    return f"{plain}_{start:06d}"


@lru_cache(maxsize=1)
def _stream(source: str, size: int, fit: Fit, span: int) -> Stream:
    return Stream(Path(source), size, fit, span)


class Stream:
    """Reads one video forwards and keeps its last frames, small: clips that follow one another cost one decoding."""

    def __init__(self, source: Path, size: int, fit: Fit, keep: int) -> None:
        self.video = open_video(source)
        self.view = framing(self.video.size, (size, size), fit)
        self._kept: deque[UInt8[np.ndarray, "s s 3"]] = deque(maxlen=keep)
        self._open(0)

    def read(self, start: int, count: int) -> list[UInt8[np.ndarray, "s s 3"]]:
        """`count` frames, at most `keep`, from `start` on; fewer at the end of the video."""
        if start < self._next - len(self._kept):
            self._open(start)
        for _ in islice(self._frames, max(start - self._next, 0)):
            self._kept.clear()
            self._next += 1
        for frame in islice(self._frames, max(start + count - self._next, 0)):
            self._kept.append(self.view.fitted(frame.image))
            self._next += 1
        first = self._next - len(self._kept)
        return list(self._kept)[start - first :][:count] if start >= first else []

    def _open(self, start: int) -> None:
        self._kept.clear()
        self._frames: Iterator[Frame] = self.video.frames(start)
        self._next = start
