"""Sketchy as a source of a run: opens what `python -m apex_lab.data.sketchy` has prepared."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.validation import PathText
from apex_lab.data.recorded import Verify, refuse_damage, told
from apex_lab.data.sketchy.recording import COMMAND, KIND, recording_folder
from apex_lab.data.sketchy.split import SPLITS
from apex_lab.data.sketchy.video_set import Sketchy
from apex_lab.data.source import VideoSource
from recordings import MANIFEST, Manifest, check

Window = Literal["full", "c0", "c1", "c2", "c3", "c4", "c5"]


class SketchySource(VideoSource):
    """Sketchy with the given settings.

    Preparing it takes long and needs files of the user: `python -m apex_lab.data.sketchy` does that.

    Args:
        root: folder of all data sets.
        name: of the recording, as given to the command.
        frames: of a clip.
        stride: timesteps from one frame to the next.
        windows: of each camera; None: all that are prepared.
        image_size: height and width in pixels; each size is prepared by itself.
        train, val, test: episodes per split at most, the first by name; None: all.
        workers: processes that load training clips; 0 loads in the training process.
        verify: when to compare all bytes with their checksums: "changed" when any file was touched since that was last
            done, "always", or "never". Sizes and headers are checked in any case.
    """

    labelled = False

    def __init__(
        self,
        root: PathText,
        name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$")] = "demos",
        frames: Annotated[int, Field(gt=0)] = 10,
        stride: Annotated[int, Field(ge=1, le=5)] = 1,
        windows: Annotated[list[Window], Field(min_length=1)] | None = None,
        image_size: Annotated[int, Field(ge=16, le=352)] = 128,
        train: Annotated[int, Field(gt=0)] | None = None,
        val: Annotated[int, Field(ge=0)] | None = None,
        test: Annotated[int, Field(ge=0)] | None = None,
        workers: Annotated[int, Field(ge=0)] = 2,
        verify: Verify = "changed",
    ) -> None:
        self.folder = recording_folder(Path(root).expanduser().absolute(), name, image_size)
        self.name, self.image_size, self.frames, self.stride = name, image_size, frames, stride
        self.windows = list(windows) if windows is not None else None
        self.limits = {"train": train, "val": val, "test": test}
        self.workers, self.verify = workers, verify
        self.sets: dict[str, Sketchy] = {}

    def refuse_missing(self) -> None:
        """Looks whether the recording is there and finished.

        Raises:
            UserError: it is not; with the command that makes it.
        """
        if not (self.folder / MANIFEST).exists():
            begun = "is not finished" if (self.folder / KIND.journal).exists() else "is not there"
            raise UserError(
                f"{self.folder} {begun}: prepare it with {self._command()}, where FOLDER holds the episodes; "
                f"{COMMAND} --help says how to get them."
            )

    def prepare(self) -> None:
        """Makes sure that the recording is there and right.

        Raises:
            UserError: it is missing, unfinished or damaged; with the command that helps.
        """
        with told():
            refuse_damage(self.folder, self._manifest(), self.verify, self._command("--repair"))

    def _manifest(self) -> Manifest[dict[str, Any]]:
        self.refuse_missing()
        with told():
            return check(self.folder, KIND)

    def _command(self, *more: str) -> str:
        words = [COMMAND, "FOLDER", "--root", str(self.folder.parent), "--name", self.name]
        return " ".join([*words, "--image-size", str(self.image_size), *more])

    def open(self) -> None:
        """Opens the splits.

        Raises:
            UserError: no episode for training is long enough.
        """
        if self.sets:
            return
        self.sets = {split: self._open(split) for split in SPLITS}
        for split, videos in self.sets.items():
            if videos.short:
                span = 1 + (self.frames - 1) * self.stride
                console.warn(f"{videos.short} episodes of {split} are left out: shorter than {span} timesteps.")
        if not len(self.sets["train"]):
            raise UserError(
                f"{self.folder} has no training clip of {self.frames} frames: lower data.frames or data.stride."
            )

    def _open(self, split: str) -> Sketchy:
        return Sketchy(self.folder, split, self.frames, self.stride, self.windows, self.limits[split])

    @property
    def fingerprint(self) -> str:
        """32 hex digits that are equal only for equal clips; call after `prepare`."""
        return hashlib.sha256(repr((self._manifest().content, sorted(self._selection().items()))).encode()).hexdigest()[
            :32
        ]

    def _selection(self) -> dict[str, Any]:
        return {"frames": self.frames, "stride": self.stride, "windows": self.windows, **self.limits}

    def describe(self) -> dict[str, Any]:
        """What a record keeps about the data; call after `prepare`."""
        manifest = self._manifest()
        counts = {f"{split}_episodes": len(manifest.settings["episodes"][split]) for split in SPLITS}
        prepared = {"image_size": self.image_size, "windows": manifest.settings["windows"]}
        return {
            "name": "sketchy",
            "folder": str(self.folder),
            "fingerprint": self.fingerprint,
            "settings": {"name": self.name, "image_size": self.image_size, **self._selection()},
            "prepared": {**prepared, **counts},
            "versions": manifest.facts["versions"],
        }
