"""Reading a finished recording through memory maps."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Generic

import numpy as np

from recordings.layout import array_path
from recordings.manifest import Manifest
from recordings.plan import Kind, S
from recordings.verify import check


class Reader(Generic[S]):
    """One split of a finished recording. Can be pickled: maps are opened at first use in each process.

    Raises:
        RecordingError: the folder is missing, unfinished, damaged, or of another kind or version.
    """

    def __init__(self, root: Path, kind: Kind[S], split: str) -> None:
        self.root, self.split = root.absolute(), split
        self.manifest: Manifest[S] = check(self.root, kind, splits=[split])
        self._arrays: dict[str, np.ndarray] = {}

    def __len__(self) -> int:
        return self.manifest.layout.counts[self.split]

    def array(self, name: str) -> np.ndarray:
        """Read-only memory map (N, ...) of an array."""
        if name not in self._arrays:
            mode = "r" if len(self) else None  # what is empty cannot be mapped
            path = array_path(self.root, self.split, name)
            self._arrays[name] = np.load(path, mmap_mode=mode, allow_pickle=False)  # type: ignore[arg-type]
        return self._arrays[name]

    def notes(self, index: int) -> dict[str, Any]:
        """The notes of an item."""
        return self.manifest.notes(self.split, index)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_arrays": {}}
