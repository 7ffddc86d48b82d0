"""Predicts one video: reads it frame by frame, writes the results in parts, joins them, puts them in place."""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np

import apex_lab
from apex_lab.base import console, interrupts
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, read_json, unwritable, write_json
from apex_lab.base.interrupts import deferring
from apex_lab.base.progress import Meter
from apex_lab.inference.segmenter import Segmenter
from apex_lab.inference.state import leaves, refilled
from apex_lab.prediction.journal import Entry, Journal
from apex_lab.prediction.objects import Reader
from apex_lab.prediction.outputs import CsvTable, IndexedPngs, Output, Overlay, ParquetTable, Rle, Tracks
from apex_lab.scene import Scene
from apex_lab.videos import Frame, Source, Video, open_video
from apex_lab.videos.reader import STILLS_PER_SECOND

BUFFER = 2**28
"""Bytes of frames that are held at a time, at most."""

MOST_AT_ONCE = 1000
"""Frames of a video for a model that needs all of them at once."""


@dataclass(frozen=True)
class Wanted:
    """What is written, and how; fields as the keys of conf/predict.yaml."""

    overlay: bool = True
    masks: Literal["png", "rle"] | None = "png"
    tracks: bool = True
    table: Literal["csv", "parquet"] | None = "csv"
    appearance: bool = True
    min_presence: float = 0.5
    every: int = 1
    frames: int | None = None
    chunk: int = 16
    save_interval: int = 500


@dataclass(frozen=True)
class Weights:
    """Which model it is: its checkpoint file, that file's SHA-256, and arguments that have other values than there."""

    file: Path
    sha256: str
    changes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Numbered:
    """A frame with its number in its video, from 0."""

    number: int
    frame: Frame


class VideoPrediction:
    """The prediction of one video.

    Args:
        segmenter: the model.
        weights: its file.
        wanted: what is written.
        video: what is read.
        folder: of the results of all videos; those of this one go to `folder / name`.
        name: of the video among the others.
    """

    def __init__(
        self, segmenter: Segmenter, weights: Weights, wanted: Wanted, video: Video, folder: Path, name: str
    ) -> None:
        self.segmenter, self.weights, self.wanted, self.video = segmenter, weights, wanted, video
        self.name, self.place = name, folder / name
        self.view = segmenter.framing(video.size)
        self.journal = Journal(folder / f".{name}.part", self.key)
        self.reader = Reader(self.view, segmenter.tracks, wanted.min_presence)
        self.outputs = self._outputs()
        self.time = 0.0  # of the last frame that was predicted

    @property
    def key(self) -> str:
        """Equal only for predictions with equal results."""
        about = {
            **{"video": self.video.stamp(), "checkpoint": self.weights.sha256, "fit": self.segmenter.fit},
            **{"wanted": asdict(self.wanted), "device": self.segmenter.predictor.device.type},
            **{"version": apex_lab.__version__},
            **({"model": dict(self.weights.changes)} if self.weights.changes else {}),
        }
        return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:32]

    def done(self) -> bool:
        """Whether the results are there.

        Raises:
            UserError: those of another request are.
        """
        if not self.place.exists():
            return False
        file = self.place / "info.json"
        if not file.is_file():
            raise UserError(f"{self.place} is there and was not made by this command: give another folder=.")
        if read_json(file).get("key") != self.key:
            raise UserError(
                f"{self.place} holds results of another checkpoint, video or other settings: "
                "add again=true to replace them, or give another folder=."
            )
        self.journal.clear()
        return True

    def run(self, again: bool = False) -> Path:
        """Predicts the video, from where an interrupted run has stopped; its folder.

        Args:
            again: start at the first frame, and replace what is there.

        Raises:
            UserError: a frame cannot be read, the disk is full, ...
            Interrupted: asked to stop; what was done is stored. A camera's video ends instead, with its results.
        """
        if again or self.video.live:
            self.journal.clear()
        began = time.monotonic()
        with deferring():
            entry = self.journal.resume(self._whole)
            done, state = self._restored(entry)
            if entry is None or not entry.ended:
                done, ended = self._predict(done, state)
                if not ended:
                    return self.place  # leaving `deferring` stops
            self._finish(done, time.monotonic() - began)
            if self.video.live:
                interrupts.answered()  # a request to stop is how a camera's video ends
        return self.place

    def _outputs(self) -> list[Output]:
        wanted = self.wanted
        found: list[Output] = []
        if wanted.overlay:
            found.append(Overlay(self.video.size, (self.video.fps or STILLS_PER_SECOND) / wanted.every))
        if wanted.masks is not None:
            found.append(IndexedPngs(self.journal.results) if wanted.masks == "png" else Rle())
        if wanted.tracks:
            found.append(Tracks())
        if wanted.table is not None:
            found.append((CsvTable if wanted.table == "csv" else ParquetTable)(wanted.appearance))
        return found

    def _whole(self, done: int) -> bool:
        """Whether the pictures of so many frames are there."""
        pngs = [output for output in self.outputs if isinstance(output, IndexedPngs)]
        paths = [output.path(i * self.wanted.every) for output in pngs for i in range(done)]
        return all(path.is_file() and path.stat().st_size for path in paths)

    def _restored(self, entry: Entry | None) -> tuple[int, Any]:
        """Frames done, and the model's state after them; the reader takes its own."""
        if entry is None:
            return 0, None
        self.time = entry.time
        values = self.reader.restore(entry.reader, entry.tensors)
        state = None
        if self.segmenter.streams:
            black = np.zeros((1, *self.segmenter.input_size, 3), dtype=np.uint8)
            template = self.segmenter.scene_of(black, self.video.name).state
            state = refilled(template, values, self.segmenter.predictor.device)
        console.say(f"{self.name}: resumes at frame {entry.done * self.wanted.every}")
        return entry.done, state

    def _predict(self, done: int, state: Any) -> tuple[int, bool]:
        """Predicts frames from the `done`-th on; how many are done then, and whether that is all of them."""
        announced = self.video.announced
        total = None if announced is None else math.ceil(announced / self.wanted.every)
        if self.wanted.frames is not None:
            total = self.wanted.frames if total is None else min(total, self.wanted.frames)
        scenes = self._scenes(done, state)
        upcoming = next(scenes, None)
        with Meter(f"{self.name}: frame", total, done) as meter:
            while upcoming is not None and not interrupts.asked():
                first = done
                with ExitStack() as parts:
                    folder = self.journal.new_part()
                    adders = [parts.enter_context(output.part(folder)) for output in self.outputs]
                    while upcoming is not None and done - first < self.wanted.save_interval:
                        frames, scene, start = upcoming
                        self.time = frames[-1].frame.time
                        for t, each in enumerate(frames):
                            predicted = self.reader(scene, start + t, each.number, each.frame)
                            for add in adders:
                                add(predicted)
                        done, state = done + len(frames), scene.state
                        meter.show(done)
                        if interrupts.asked():
                            break
                        upcoming = next(scenes, None)
                ended = upcoming is None or (self.video.live and interrupts.asked() is not None)
                tensors = [*self.reader.tensors(), *leaves(state if self.segmenter.streams else None)]
                self.journal.close_part(Entry(done, ended, self.time, self.reader.stored(), tensors))
                if ended:
                    return done, True
        return done, upcoming is None

    def _scenes(self, done: int, state: Any) -> Iterator[tuple[list[Numbered], Scene, int]]:
        """Frames from the `done`-th on, some at a time, with a scene and the place of the first of them in it."""
        frames = self._frames(done)
        height, width = self.video.size
        chunk = min(self.wanted.chunk, max(1, BUFFER // (3 * height * width)))
        whole = None if self.segmenter.streams else self._whole_scene()
        while some := list(islice(frames, chunk)):
            if whole is None:
                images = np.stack([self.view.fitted(each.frame.image) for each in some])
                scene = self.segmenter.scene_of(images, self.video.name, done, state)
                yield some, scene, 0
                state = scene.state
            else:
                yield some, whole, done
            done += len(some)

    def _whole_scene(self) -> Scene:
        """The scene of all frames, which are read once more for the results."""
        small = [self.view.fitted(each.frame.image) for each in islice(self._frames(0), MOST_AT_ONCE + 1)]
        if len(small) > MOST_AT_ONCE:
            model = type(self.segmenter.predictor.model).__name__
            raise UserError(
                f"{model} needs the whole video at once, and {self.video.source} has more than {MOST_AT_ONCE} frames: "
                f"give frames={MOST_AT_ONCE}, or a larger every=."
            )
        return self.segmenter.scene_of(np.stack(small), self.video.name)

    def _frames(self, start: int) -> Iterator[Numbered]:
        """The frames that are wanted, from the `start`-th of them on."""
        every, last = self.wanted.every, self.wanted.frames
        numbered = enumerate(self.video.frames(start * every), start * every)
        wanted = (Numbered(number, frame) for number, frame in numbered if number % every == 0)
        yield from islice(wanted, None if last is None else max(last - start, 0))

    def _finish(self, done: int, seconds: float) -> None:
        """Joins the parts and puts the results in place."""
        results = self.journal.results
        rate = (done - 1) / self.time if self.time > 0 else None
        for output in self.outputs:
            output.join(results, self.journal.parts, rate)
        write_json(results / "info.json", self._info(done))
        make_folder(self.place.parent)
        old = self.journal.folder / "replaced"
        if self.place.exists():
            os.replace(self.place, old)
        os.replace(results, self.place)
        self.journal.clear()
        objects = len(self.reader.names.ids)
        found = f"{objects} object{'' if objects == 1 else 's'}"
        console.say(f"{self.name}: {done} frames, {found}, {done / max(seconds, 1e-9):.1f} frames per second")

    def _info(self, done: int) -> dict[str, Any]:
        """What info.json says; notes go to the terminal too."""
        segmenter, wanted, video = self.segmenter, self.wanted, self.video
        model = segmenter.predictor.model
        notes = []
        if wanted.frames is None:
            step = self.time / max((done - 1) * wanted.every, 1)
            # up to every - 1 frames after the last one that was wanted are there too
            cut_off = video.cut_off(done * wanted.every, self.time + (wanted.every - 1) * step)
            notes += [] if cut_off is None else [cut_off]
        if not segmenter.tracks:
            notes.append(f"{type(model).__name__} does not track: objects are linked by the overlap of their masks")
        if self.reader.names.reused and wanted.masks == "png":
            notes.append("more than 254 objects: an index of the masks stands for several, see mask_index of the table")
        for note in notes:
            console.warn(f"{self.name}: {note}.")
        return {
            "key": self.key,
            "video": {
                **{"source": str(video.source), "frames_announced": video.announced, "fps": video.fps},
                **{"height": video.size[0], "width": video.size[1]},
            },
            "frames": done,
            "objects": len(self.reader.names.ids),
            "identities": "model" if segmenter.tracks else "linked",
            "framing": self.view.described(),
            "model": type(model).__name__,
            "checkpoint": {"file": str(self.weights.file), "sha256": self.weights.sha256},
            "settings": {**asdict(wanted), **({"model": dict(self.weights.changes)} if self.weights.changes else {})},
            "files": [output.name for output in self.outputs],
            "notes": notes,
            "device": segmenter.predictor.device.type,
            "version": apex_lab.__version__,
        }


def predict_video(
    segmenter: Segmenter, weights: Weights, wanted: Wanted, source: Source, folder: Path, name: str, again: bool
) -> Path:
    """Predicts a video, unless that has been done; the folder of its results.

    Args:
        segmenter, weights, wanted, folder, name: as of `VideoPrediction`.
        source: the video.
        again: replace what is there.

    Raises:
        UserError: the video cannot be read, the results cannot be written, or others are there.
        Interrupted: asked to stop.
    """
    video = open_video(source)
    if video.live:
        name = f"{name}_{time.strftime('%Y%m%d_%H%M%S')}"
        if not segmenter.streams:
            raise UserError(f"Camera {source} has no end, and this model needs the whole video at once.")
    work = VideoPrediction(segmenter, weights, wanted, video, folder, name)
    if not again and work.done():
        console.say(f"{work.place}: done before (again=true does it once more)")
        return work.place
    try:
        return work.run(again)
    except OSError as error:
        raise unwritable(work.place, error) from error


def unique_names(sources: Sequence[Source]) -> dict[Source, str]:
    """A folder name for each video: the file's without its ending, with a few digits of its path where two have it."""
    plain = {source: _plain(source) for source in sources}
    counts: Mapping[str, int] = {name: sum(n == name for n in plain.values()) for name in plain.values()}
    return {source: name if counts[name] == 1 else f"{name}_{_short(source)}" for source, name in plain.items()}


def _plain(source: Source) -> str:
    if isinstance(source, int):
        return f"camera_{source}"
    name = source.resolve().name if source.is_dir() else source.stem
    return name.lstrip(".") or "video"


def _short(source: Source) -> str:
    return hashlib.sha256(str(Path(str(source)).resolve()).encode()).hexdigest()[:8]
