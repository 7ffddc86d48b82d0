"""What has been done of a video, so that an interrupted prediction resumes: beside the results in the making.

A working folder `.<name>.part` holds `results/` (what becomes the video's folder), `parts/00000/, ...` and, after
each closed part, `journal.json` with the number of frames done and the tensors of the model's state.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, read_json, replacing, write_json
from apex_lab.inference.state import Leaf


@dataclass(frozen=True)
class Entry:
    """What the journal says after a part.

    Attributes:
        done: frames that were predicted.
        ended: the video has no more.
        time: of the last of them, in seconds.
        reader: plain values of the reader of objects.
        tensors: of the model's state and of the reader.
    """

    done: int
    ended: bool
    time: float
    reader: Mapping[str, Any]
    tensors: Sequence[Leaf] = field(default=(), repr=False)


class Journal:
    """The working folder of one video.

    Args:
        folder: it.
        key: of the request; what another one has left is removed.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.folder, self.key = folder, key

    @property
    def results(self) -> Path:
        """The folder of results in the making."""
        return self.folder / "results"

    @property
    def parts(self) -> list[Path]:
        """The folders of parts, in order."""
        return sorted((self.folder / "parts").glob("[0-9]*"))

    def resume(self, whole: Callable[[int], bool]) -> Entry | None:
        """What was done before of this very request; None, and an empty folder, where that is nothing of use.

        Args:
            whole: whether the results that are no parts are there, for so many frames.
        """
        file = self.folder / "journal.json"
        try:
            content = read_json(file) if file.is_file() else {}
        except UserError:
            content = {}
        if content.get("key") == self.key:
            entry = self._entry(content)
            if entry is not None and whole(entry.done):
                for part in self.parts[len(content["parts"]) :]:
                    shutil.rmtree(part)  # was not closed
                make_folder(self.results)
                return entry
            console.warn(f"{self.folder} is damaged; the video starts again.")
        self.clear()
        make_folder(self.results)
        return None

    def new_part(self) -> Path:
        """The folder of the next part."""
        return make_folder(self.folder / "parts" / f"{len(self.parts):05d}")

    def close_part(self, entry: Entry) -> None:
        """Notes that all parts so far are whole.

        Raises:
            UserError: the disk is full.
        """
        state = self._state(len(self.parts))
        with replacing(state) as file:
            torch.save(list(entry.tensors), file)
        content = {"key": self.key, "done": entry.done, "ended": entry.ended, "time": entry.time}
        parts = [_sizes(part) for part in self.parts]
        write_json(self.folder / "journal.json", {**content, "reader": dict(entry.reader), "parts": parts})
        for old in self.folder.glob("state_*.pt"):
            if old != state:
                old.unlink()

    def clear(self) -> None:
        """Removes everything."""
        if self.folder.exists():
            shutil.rmtree(self.folder)

    def _entry(self, content: Mapping[str, Any]) -> Entry | None:
        try:
            parts, closed = self.parts, content["parts"]
            if not isinstance(closed, list) or not 0 < len(closed) <= len(parts):
                return None
            if any(_sizes(part) != sizes for part, sizes in zip(parts, closed, strict=False)):
                return None
            done, ended, time, reader = (content[name] for name in ("done", "ended", "time", "reader"))
            if type(done) is not int or type(ended) is not bool or not isinstance(reader, dict):
                return None
            tensors = torch.load(self._state(len(closed)), weights_only=True)
        except Exception:  # noqa: BLE001 - what is raised for damaged bytes has no common class
            return None
        return Entry(done, ended, time, reader, tensors)

    def _state(self, parts: int) -> Path:
        return self.folder / f"state_{parts:05d}.pt"


def _sizes(part: Path) -> dict[str, int]:
    """Name -> bytes of the files of a part."""
    return {file.name: file.stat().st_size for file in sorted(part.iterdir())}
