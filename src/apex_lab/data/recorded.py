"""Data sets that stand in a recording: read through memory maps; made, checked and opened by one source."""

from __future__ import annotations

import os
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from apex_lab.base.errors import UserError
from apex_lab.data.source import VideoSource
from apex_lab.data.video_set import MEDIAN_SAMPLE, Clip, VideoSet
from recordings import MANIFEST, Kind, Maker, Manifest, Plan, Reader, RecordingError, check, is_verified, record, verify

Verify = Literal["changed", "always", "never"]


@contextmanager
def told() -> Iterator[None]:
    """Turns the store's errors into those of this package."""
    try:
        yield
    except RecordingError as error:
        raise UserError(str(error)) from error


def refuse_damage(folder: Path, manifest: Manifest[Any], when: Verify, command: str) -> None:
    """Compares all bytes with their checksums, if that is due.

    Args:
        folder: a finished recording.
        manifest: its manifest.
        when: as `RecordedSource.verify`.
        command: repairs the folder.

    Raises:
        UserError: it is damaged.
    """
    if when == "always" or (when == "changed" and not is_verified(folder, manifest)):
        damage = verify(folder, manifest)
        if damage:
            lines = damage.lines()
            more = f" and {len(lines) - 1} more" if len(lines) > 1 else ""
            raise UserError(f"{folder} is damaged ({lines[0]}{more}): repair it with {command}")


def merged(fixed: Mapping[str, Any], simulation: Mapping[str, Any] | None) -> dict[str, Any]:
    """Values of the settings of simulated data.

    Args:
        fixed: those that are keys of `data`; `seed` is `data.data_seed`.
        simulation: the further ones.

    Raises:
        UserError: one is given in both.
    """
    further = dict(simulation or {})
    for key in further:
        if key in fixed:
            word = "data_seed" if key == "seed" else key
            raise UserError(f"simulation.{key} is not a key: set data.{word} instead")
    return {**fixed, **further}


class RecordedSet(VideoSet):
    """One split of a finished recording with a field `rgb` (T, H, W, 3) and, if it is labelled, `segmentation`.

    A video's name is the note `name` of its item if the kind has that note, else its split and number.

    Args:
        root: folder of the recording.
        kind: its kind.
        split: one of its splits.
        frames: length of the videos; None: all frames.
        start: first frame.

    Raises:
        UserError: no such split or frames, or the folder is missing, unfinished, damaged, of another kind or version.
    """

    def __init__(
        self, root: str | Path, kind: Kind[Any], split: str, frames: int | None = None, start: int = 0
    ) -> None:
        self.root, self.split = Path(root).absolute(), split
        with told():
            self.reader = Reader(self.root, kind, split)
        fields = self.manifest.layout.fields
        self.labelled = "segmentation" in fields
        self._named = "name" in kind.notes
        stored = self.manifest.layout.shape("rgb")[0]
        end = stored if frames is None else start + frames
        if not 0 <= start < end <= stored:
            raise UserError(f"frames {start} to {end - 1} of {self.root} cannot be read: it has 0 to {stored - 1}")
        self.clip = slice(start, end)

    @property
    def manifest(self) -> Manifest[Any]:
        """Everything about the recording except its arrays."""
        return self.reader.manifest

    def __len__(self) -> int:
        return len(self.reader)

    def length(self, video: int) -> int:
        """Frames of a video; all have the same number."""
        return self.clip.stop - self.clip.start

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W) in pixels."""
        height, width = self.manifest.layout.shape("rgb")[1:3]
        return height, width

    def name(self, video: int) -> str:
        """As exports name it."""
        return str(self.reader.notes(video)["name"]) if self._named else f"{self.split}_{video:05d}"

    def read(self, clip: Clip) -> dict[str, Tensor]:
        """Frames and labels of a clip."""
        start = self.clip.start + clip.start
        stop = self.clip.stop if clip.frames is None else start + clip.frames
        if not self.clip.start <= start < stop <= self.clip.stop:
            raise IndexError(f"frames {clip.start} to {stop - self.clip.start - 1} of {self.length(clip.video)}")
        video = self.reader.array("rgb")[clip.video, start:stop].transpose(0, 3, 1, 2)
        found = {"video": torch.from_numpy(np.array(video, order="C"))}
        if self.labelled:
            found["segmentation"] = torch.from_numpy(
                np.array(self.reader.array("segmentation")[clip.video, start:stop])
            )
        return found

    def median(self, sample: int | None = MEDIAN_SAMPLE) -> Float[Tensor, "3 H W"]:
        """Per-pixel median image in [0, 1]: the static background; kept in the folder.

        Args:
            sample: number of frames, evenly spaced over the split; None: all of them, which takes long.
        """
        total = len(self) * self.length(0)
        if total == 0:
            raise UserError(f"split {self.split} of {self.root} is empty, so it has no median image")
        count = total if sample is None else min(sample, total)
        cache = self.root / f".median_{self.split}_{count}_{self.manifest.content[:8]}.npy"
        with suppress(OSError, ValueError, EOFError, TypeError, MemoryError):  # not there, or damaged: computed again
            found = torch.from_numpy(np.load(cache, allow_pickle=False))
            if found.shape == (3, *self.image_size) and found.dtype == torch.float32:
                return found
        median = super().median(sample).numpy()
        draft = cache.with_name(f"{cache.name}.{os.getpid()}")
        with suppress(OSError):  # where nothing can be written, it is computed every time
            with open(draft, "wb") as file:
                np.save(file, median)
            os.replace(draft, cache)
        return torch.from_numpy(median)


class RecordedSource(VideoSource):
    """A data set in a folder of its own below `root`; data that exist are used, missing ones are made once.

    A subclass gives the kind, the plan, the maker and the folder; it may open sets of its own.

    Args:
        workers: processes that load training clips; 0 loads in the training process.
        generate: make missing data; False: refuse.
        sim_workers: processes that make data; None: one per core.
        verify: when to compare all bytes with their checksums: "changed" when any file was touched since that was last
            done, "always", or "never". Sizes and headers are checked in any case.
    """

    kind: Kind[Any]

    def __init__(self, workers: int, generate: bool, sim_workers: int | None, verify: Verify) -> None:
        self.workers = workers
        self.generate, self.sim_workers, self.verify = generate, sim_workers, verify
        self.sets = {}

    @property
    @abstractmethod
    def folder(self) -> Path:
        """Where the recording is; its name holds the plan's fingerprint, so different data never meet."""

    @abstractmethod
    def plan(self) -> Plan[Any]:
        """What the folder must hold."""

    @abstractmethod
    def maker(self) -> Maker:
        """Makes the items."""

    def make(self) -> None:
        """Makes missing data."""
        record(self.folder, self.plan(), self.maker(), workers=self.sim_workers)

    def make_command(self) -> str:
        """The shell command that makes missing data."""
        return self.kind.make_command.format(root=self.folder)

    def refuse_missing(self) -> None:
        """Looks whether data that may not be made are there.

        Raises:
            UserError: they are not.
        """
        self._refuse_unmade()

    def _refuse_unmade(self) -> None:
        if not self.generate and not (self.folder / MANIFEST).exists():
            raise UserError(
                f"no finished {self.kind.name} data at {self.folder}: "
                f"set data.generate=true or run {self.make_command()}"
            )

    def prepare(self) -> None:
        """Makes sure that the data are there and are right; the first time that can take minutes.

        Raises:
            UserError: they are missing and cannot or may not be made, are damaged, or the disk is full.
        """
        with told():
            self._refuse_unmade()
            folder = self.folder
            if not (folder / MANIFEST).exists():
                self.make()
            manifest = check(folder, self.kind, self.plan())
            refuse_damage(folder, manifest, self.verify, self.kind.repair_command.format(root=folder))

    def open(self) -> None:
        """Opens the splits."""
        if not self.sets:
            self.sets = {split: self.opened(split) for split in ("train", "val", "test")}

    def opened(self, split: str) -> VideoSet:
        """One split."""
        return RecordedSet(self.folder, self.kind, split)

    def manifest(self) -> Manifest[Any]:
        """Of the prepared folder."""
        with told():
            return check(self.folder, self.kind, self.plan())

    @property
    def fingerprint(self) -> str:
        """32 hex digits that are equal only for equal bytes; call after `prepare`."""
        return self.manifest().content

    def describe(self) -> dict[str, Any]:
        """What a record keeps about the data; call after `prepare`."""
        manifest = self.manifest()
        return {
            "name": self.kind.name.lower(),
            "folder": str(self.folder),
            "fingerprint": manifest.content,
            "settings": self.kind.dump(manifest.settings),
            "versions": manifest.facts["versions"],
        }
