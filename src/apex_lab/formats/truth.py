"""Ground truth for predictions that come without: an npz file, a P2D folder, or a folder of DAVIS-style PNGs."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Integer

from apex_lab.base.errors import UserError
from apex_lab.data.p2d import P2D, p2d_video_name
from apex_lab.formats.davis import read_davis, video_names
from apex_lab.formats.npz import NpzFile
from apex_lab.metrics.objects import ObjectMetadata, p2d_metadata


@runtime_checkable
class Truth(Protocol):
    """Ground truth of some videos, read one at a time."""

    names: list[str]

    def labels(self, name: str) -> Integer[np.ndarray, "T H W"]:
        """True labels of one video, 0 is the background."""

    def metadata(self, name: str) -> ObjectMetadata | None:
        """What else is known of its objects."""


class NpzTruth:
    """The arrays `V__gt` of an npz file."""

    def __init__(self, path: str | Path) -> None:
        self._file = NpzFile(path, need=("gt",))
        self.names = self._file.names

    def labels(self, name: str) -> Integer[np.ndarray, "T H W"]:
        """True labels of one video."""
        return self._file.truth(name)

    def metadata(self, name: str) -> None:
        """Nothing is known."""


class P2DTruth:
    """One split of a P2D folder; videos are named as `p2d_video_name` says."""

    def __init__(self, root: str | Path, split: str) -> None:
        self._data = P2D(root, split)
        self._index = {p2d_video_name(split, index): index for index in range(len(self._data))}
        self.names = list(self._index)

    def labels(self, name: str) -> Integer[np.ndarray, "T H W"]:
        """True labels of one video."""
        return self._data[self._index[name]]["segmentation"].numpy()

    def metadata(self, name: str) -> ObjectMetadata:
        """Class, occlusion and contact of its objects."""
        return p2d_metadata(self._data.meta(self._index[name]))


class DavisTruth:
    """A folder of palette PNGs per video."""

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self.names = video_names(path)

    def labels(self, name: str) -> Integer[np.ndarray, "T H W"]:
        """True labels of one video."""
        return read_davis(self._path, name)

    def metadata(self, name: str) -> None:
        """Nothing is known."""


def open_truth(path: str | Path, split: str = "test") -> Truth:
    """Ground truth of any kind; `split` is for a P2D folder.

    Raises:
        UserError: nothing there that could be ground truth.
    """
    path = Path(path)
    if path.is_file() and path.suffix != ".json":
        return NpzTruth(path)
    if (path / "manifest.json").is_file():
        return P2DTruth(path, split)
    if path.is_dir() and video_names(path):
        return DavisTruth(path)
    raise UserError(
        f"{path} holds no ground truth: want an npz file with arrays V__gt, a P2D folder, or a folder with a folder of "
        "PNGs per video"
    )
