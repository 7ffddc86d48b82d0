"""`data=video`: a folder of a person's own videos as a source of a run."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.validation import PathText
from apex_lab.data.own_videos import cutting
from apex_lab.data.own_videos.cutting import SPLITS, SplitBy
from apex_lab.data.own_videos.maker import KIND, ClipMaker, Settings, clips_of, cut_of, plan_of
from apex_lab.data.own_videos.scan import Scanned, find, scan
from apex_lab.data.recorded import RecordedSource, Verify, told
from apex_lab.videos import Fit
from recordings import MANIFEST, Manifest, Plan, read_manifest

SHOWN = 20
"""Skipped videos that are named on the terminal; the manifest names all. Likewise those that end early."""


class OwnVideosSource(RecordedSource):
    """Videos without labels, cut into clips of one length and size once and kept in a folder of their own below `root`.

    Videos that cannot be read, or are too short for one clip, are named and skipped. Where there are few videos, each
    is split by time: its first clips are for training, its last for testing.

    Args:
        root: folder of all recordings.
        path: folder with videos (files that OpenCV reads, folders of pictures), a pattern with `*`, one video, or the
            folder of a finished recording of own videos.
        train, val, test: clips per split, at most; from more, evenly spaced ones are taken.
        frames: frames per clip.
        image_size: height and width of clips in pixels.
        stride: every so many frames of a video one is taken.
        hop: frames of the video from the start of a clip to that of the next; None: clips follow one another.
        fit: crop: the largest square in the middle of a frame; letterbox: all of it, with black bars.
        split_by: video: a video belongs to one split; time: every video is split; auto: by video from
            `cutting.FEW` videos on.
        val_share, test_share: of the videos, or of the clips where they are split by time.
        workers: processes that load training clips; 0 loads in the training process.
        prepare_workers: processes that cut clips; None: one per core; 0: the training process.
        verify: when to compare all bytes with their checksums, as for P2D.
        generate: cut clips that are missing; False: refuse, and write nothing.

    Raises:
        UserError: no path, or shares that leave nothing for training.
    """

    kind = KIND
    labelled = False

    def __init__(
        self,
        root: PathText,
        path: str | None = None,
        train: Annotated[int, Field(gt=0)] = 2000,
        val: Annotated[int, Field(gt=0)] = 200,
        test: Annotated[int, Field(gt=0)] = 200,
        frames: Annotated[int, Field(gt=0)] = 20,
        image_size: Annotated[int, Field(ge=16, le=1024)] = 128,
        stride: Annotated[int, Field(gt=0)] = 1,
        hop: Annotated[int, Field(gt=0)] | None = None,
        fit: Fit = "crop",
        split_by: SplitBy = "auto",
        val_share: Annotated[float, Field(gt=0, lt=1)] = 0.1,
        test_share: Annotated[float, Field(gt=0, lt=1)] = 0.1,
        workers: Annotated[int, Field(ge=0)] = 2,
        prepare_workers: Annotated[int, Field(ge=0)] | None = None,
        verify: Verify = "changed",
        generate: bool = True,
    ) -> None:
        if not path:
            raise UserError("data=video needs videos: set data.path=FOLDER, a folder of video files or of pictures.")
        if val_share + test_share >= 1:
            raise UserError(
                f"data.val_share = {val_share:g} and data.test_share = {test_share:g} leave nothing for training: "
                "their sum must be below 1."
            )
        super().__init__(workers, generate, prepare_workers, verify)
        self.root, self.path = Path(root).expanduser().absolute(), path
        span = (frames - 1) * stride + 1
        self._wished: Settings = {
            **{"frames": frames, "image_size": image_size, "stride": stride, "hop": hop or span, "fit": fit},
            **{"val_share": val_share, "test_share": test_share, "train": train, "val": val, "test": test},
        }
        self._split_by: SplitBy = split_by

    def refuse_missing(self) -> None:
        """Looks whether the path names videos; whether they can be read is found out by `prepare`.

        Raises:
            UserError: it names none, or a recording of other settings.
        """
        if self._ready is None:
            find(self.path)

    def prepare(self) -> None:
        """Looks at the videos and cuts them, unless that has been done before.

        Raises:
            UserError: there is no usable video, or the disk is full.
        """
        if self._ready is None:
            _tell(self._found, *sorted_out(self._found, self._wished))
        super().prepare()
        manifest = self.manifest()
        counts = ", ".join(f"{count} {split}" for split, count in manifest.layout.counts.items())
        by = "by video" if manifest.settings["split_by"] == "video" else "by time within each video"
        console.say(f"own videos: {len(manifest.settings['videos'])} videos, clips split {by}: {counts}; {self.folder}")

    @cached_property
    def _ready(self) -> Manifest[Settings] | None:
        """The manifest of the recording that `path` names, if it names one."""
        path = Path(self.path).expanduser()
        if not (path / MANIFEST).is_file():
            return None
        with told():
            manifest = read_manifest(path.absolute(), KIND)
        for key, wish in self._wished.items():
            there = manifest.settings[key]
            if key not in SPLITS and there != wish:  # how many there are is known: all are used
                raise UserError(f"{path} was made with {key} = {there} and not {wish}: set data.{key}={there}.")
        return manifest

    @cached_property
    def _found(self) -> list[Scanned]:
        """All videos."""
        place = hashlib.sha256(str(Path(self.path).expanduser().absolute()).encode()).hexdigest()[:16]
        return scan(find(self.path), self.root / f".own_videos_{place}.json", keep=self.generate)

    @cached_property
    def _settings(self) -> Settings:
        usable, skipped = sorted_out(self._found, self._wished)
        if not usable:
            raise UserError(f"data.path = {self.path} holds no usable video ({len(skipped)} skipped: {skipped[0][1]})")
        videos = [{"name": video.name, "digest": video.digest, "frames": video.frames} for video in usable]
        settings = {
            "videos": videos,
            **self._wished,
            "split_by": cutting.split_by(self._split_by, len(videos)),
        }
        empty = [split for split, clips in clips_of(settings).items() if not clips]
        if empty:
            raise UserError(
                f"data.path = {self.path} gives no clip for {' and '.join(empty)} ({len(videos)} videos, split by "
                f"{settings['split_by']}): add videos or longer ones, or lower data.frames, data.stride or data.hop."
            )
        return settings

    @property
    def folder(self) -> Path:
        """Where the clips are."""
        if self._ready is not None:
            return Path(self.path).expanduser().absolute()
        settings = self._settings
        size = f"{settings['image_size']}px_{settings['frames']}f"
        return self.root / f"own_videos_{size}_{self.plan().fingerprint[:8]}"

    def plan(self) -> Plan[Settings]:
        """What the folder must hold."""
        return self._ready.plan if self._ready is not None else self._plan

    @cached_property
    def _plan(self) -> Plan[Settings]:
        return plan_of(self._settings)

    def maker(self) -> ClipMaker:
        """Reads the clips."""
        usable, skipped = sorted_out(self._found, self._wished)
        about = {
            "source": str(Path(self.path).expanduser().absolute()),
            "skipped": [{"video": video.name, "why": why} for video, why in skipped],
        }
        return ClipMaker(self._settings, [str(Path(video.path).absolute()) for video in usable], about)

    def describe(self) -> dict[str, Any]:
        """What a record keeps about the data; call after `prepare`."""
        settings = self.manifest().settings
        return {**super().describe(), "settings": {**settings, "videos": len(settings["videos"])}}


def sorted_out(found: Sequence[Scanned], settings: Settings) -> tuple[list[Scanned], list[tuple[Scanned, str]]]:
    """The usable videos, and the others with the reason."""
    span = cut_of(settings).span
    usable, skipped = [], []
    contents: dict[str, str] = {}
    for video in found:
        if video.problem is not None:
            skipped.append((video, video.problem))
        elif video.frames < span:
            skipped.append((video, f"{video.path} is too short: it has {video.frames} frames, a clip needs {span}."))
        elif video.digest in contents:
            skipped.append((video, f"{video.path} has the same content as {contents[video.digest]}."))
        else:
            contents[video.digest] = video.path
            usable.append(video)
    return usable, skipped


def _tell(found: Sequence[Scanned], usable: Sequence[Scanned], skipped: Sequence[tuple[Scanned, str]]) -> None:
    """Names what is skipped, and videos that end before they should."""
    short = [f"{video.path}: {video.cut_off}." for video in usable if video.cut_off is not None]
    _list(f"{len(skipped)} of {len(found)} videos are skipped:", [why for _, why in skipped])
    _list(f"{len(short)} of {len(found)} videos end early and are used as far as they go:", short)


def _list(heading: str, lines: Sequence[str]) -> None:
    if lines:
        console.warn(heading)
        for line in lines[:SHOWN]:
            console.warn(f"  {line}")
        if len(lines) > SHOWN:
            console.warn(f"  and {len(lines) - SHOWN} more")
