"""Ground truth for predictions that come without: npz, P2D, PNGs, MOTS text, and JSON of COCO or Weis et al."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Integer

from apex_lab.base.errors import UserError
from apex_lab.base.faults import cited
from apex_lab.data.p2d import P2D
from apex_lab.formats.bounds import check_file
from apex_lab.formats.coco import CocoTruth
from apex_lab.formats.davis import frame_files, read_davis, video_names
from apex_lab.formats.mots import MotsTruth, text_names
from apex_lab.formats.npz import NpzFile
from apex_lab.formats.weis import WeisTruth
from apex_lab.metrics.ignored import likely_void
from apex_lab.metrics.objects import ObjectMetadata, p2d_metadata
from sims.p2d.export import video_name as p2d_video_name


@runtime_checkable
class Truth(Protocol):
    """Ground truth of some videos, read one at a time."""

    names: list[str]

    def labels(self, name: str) -> Integer[np.ndarray, "T H W"]:
        """True labels of one video, 0 is the background."""

    def metadata(self, name: str) -> ObjectMetadata | None:
        """Metadata of its objects."""

    def numbers(self, name: str) -> list[int] | None:
        """The numbers of its frames, ascending; None where frames have a place and no number."""

    def void(self, name: str) -> int | None:
        """A label that the file itself marks as one to ignore."""


class NpzTruth:
    """The arrays `V__gt` of an npz file."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._file = NpzFile(path, need=("gt",))
        self.names = self._file.names

    def labels(self, name: str) -> Integer[np.ndarray, "T H W"]:
        """True labels of one video."""
        return self._file.truth(name)

    def metadata(self, name: str) -> None:
        """Nothing is known."""

    def numbers(self, name: str) -> None:
        """Frames have no numbers."""

    def void(self, name: str) -> None:
        """Nothing is marked."""


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

    def numbers(self, name: str) -> None:
        """Frames have no numbers."""

    def void(self, name: str) -> None:
        """Nothing is marked."""


class DavisTruth:
    """A folder of palette or grey PNGs per video."""

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self.names = video_names(path)

    def labels(self, name: str) -> Integer[np.ndarray, "T H W"]:
        """True labels of one video."""
        return read_davis(self._path, name)

    def metadata(self, name: str) -> None:
        """Nothing is known."""

    def numbers(self, name: str) -> list[int]:
        """The numbers in the names of its files."""
        return list(frame_files(self._path, name))

    def void(self, name: str) -> None:
        """Nothing is marked."""


def open_truth(path: str | Path, split: str = "test") -> Truth:
    """Ground truth of any kind; `split` is for a P2D folder.

    Raises:
        UserError: nothing there that could be ground truth.
    """
    path = Path(path)
    if path.is_file() and path.suffix.lower() == ".json":
        return _json_truth(path)
    if path.is_file():
        return NpzTruth(path)
    if (path / "manifest.json").is_file():
        return P2DTruth(path, split)
    if path.is_dir() and video_names(path):
        return DavisTruth(path)
    if path.is_dir() and (text_names(path) or any(path.glob("[!.]*/gt/gt.txt"))):
        return MotsTruth(path)
    raise UserError(
        f"{path} holds no ground truth: want an npz file with arrays V__gt, a P2D folder, a folder with a folder of "
        "PNGs per video, MOTS text (V.txt or V/gt/gt.txt), or JSON in the layout of COCO or Weis et al."
    )


def load_json(path: Path) -> Any:
    """Content of a JSON file.

    Raises:
        UserError: there is none, or it is damaged.
    """
    try:
        check_file(path)
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise UserError(f"there is no file {path}") from error
    except (ValueError, OSError, RecursionError) as error:
        raise UserError(f"{path} is no readable JSON file ({cited(error)})") from error


def void_label(truth: Truth, name: str, labels: Integer[np.ndarray, "T H W"]) -> int | None:
    """A label of a video that marks pixels to ignore, by the file's word or by convention (`likely_void`)."""
    marked = truth.void(name)
    return likely_void(labels) if marked is None else marked


def _json_truth(path: Path) -> Truth:
    content = load_json(path)
    if isinstance(content, dict) and "annotations" in content:
        return CocoTruth(content, path)
    if isinstance(content, list) and content and all(isinstance(video, list) for video in content):
        return WeisTruth(content, path)
    raise UserError(
        f"{path} holds no ground truth: want an object with videos, images and annotations (COCO) or a list of videos "
        "with frames (Weis et al.); a result list holds predictions"
    )
