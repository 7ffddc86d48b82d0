"""Reads MOTS text: `frame id class height width mask` a line, frames and ids counted from 1.

Boxes (MOTChallenge) hold no masks and cannot be scored here.
"""

from __future__ import annotations

import configparser
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from apex_lab.base.errors import UserError
from apex_lab.base.order import natural_key
from apex_lab.formats.mot import IGNORED_CLASS
from apex_lab.formats.rle import paint
from apex_lab.formats.video import with_rest
from apex_lab.metrics.contingency import BACKGROUND
from apex_lab.scene import ABSENT


@dataclass(frozen=True)
class _Line:
    """One mask: frame counted from 0, id and class as they stand there, and where that is."""

    frame: int
    id: int
    kind: int
    mask: dict[str, object]
    where: str


def text_names(path: str | Path) -> list[str]:
    """The videos of a folder of `V.txt`, in natural order (v2 before v10)."""
    return sorted((file.stem for file in Path(path).glob("[!.]*.txt")), key=natural_key)


def read_mots(path: str | Path, name: str, shape: tuple[int, int, int]) -> Int64[np.ndarray, "T H W"]:
    """Identity map of one video from its MOTS lines.

    Pixels of no mask form one more segment over the whole video; see `video.with_rest`.

    Args:
        path: the folder.
        name: of the video.
        shape: (T, H, W) of the ground truth.

    Raises:
        UserError: no such file, a line of another kind (boxes hold no masks), masks that overlap or have another size.
    """
    file = Path(path) / f"{name}.txt"
    if not file.is_file():
        raise UserError(f"there is no file {file} for video {name!r}")

    def place(found: Int64[np.ndarray, "T H W"]) -> None:
        for line in _lines(file):
            if line.frame >= shape[0]:
                raise UserError(f"{line.where}: frame {line.frame + 1} is none of the {shape[0]} of the ground truth")
            paint(found[line.frame], line.mask, line.id - 1, ABSENT, line.where)

    return with_rest(place, shape)


class MotsTruth:
    """Ground truth in a folder of `V.txt` or, as the MOTChallenge lays it out, of `V/gt/gt.txt`.

    Ids are the labels; pixels of no mask are background. `V/seqinfo.ini` holds length and size of V; without it the
    last mask's frame is the last one.

    Args:
        path: the folder.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        flat = {name: self._path / f"{name}.txt" for name in text_names(path)}
        nested = {file.parent.parent.name: file for file in self._path.glob("[!.]*/gt/gt.txt")}
        self._files = flat or nested
        self.names = sorted(self._files, key=natural_key)

    def labels(self, name: str) -> Int64[np.ndarray, "T H W"]:
        """True labels of one video.

        Raises:
            UserError: boxes, masks that overlap or differ in size, frames after the end, or no way to know the size.
        """
        lines = list(_lines(self._files[name]))
        found = np.full(self._shape(name, lines), ABSENT, dtype=np.int64)
        for line in lines:
            if line.frame >= len(found):
                raise UserError(f"{line.where}: frame {line.frame + 1} is none of the {len(found)} of seqinfo.ini")
            paint(found[line.frame], line.mask, line.id, ABSENT, line.where, "the video")
        return np.where(found == ABSENT, BACKGROUND, found)

    def metadata(self, name: str) -> None:
        """Nothing is known."""

    def numbers(self, name: str) -> None:
        """Frames are counted, they have no names."""

    def void(self, name: str) -> int | None:
        """The id of a region that is marked as one to ignore (class 10)."""
        return next((line.id for line in _lines(self._files[name]) if line.kind == IGNORED_CLASS), None)

    def _shape(self, name: str, lines: list[_Line]) -> tuple[int, int, int]:
        info = configparser.ConfigParser()
        place = self._path / name / "seqinfo.ini"
        try:
            info.read(place, encoding="utf-8")
            if info.has_section("Sequence"):
                frames, width, height = (info.getint("Sequence", key) for key in ("seqLength", "imWidth", "imHeight"))
                return frames, height, width
        except (configparser.Error, ValueError, UnicodeDecodeError) as error:
            raise UserError(f"{place} does not tell seqLength, imWidth and imHeight ({error}); correct it") from error
        if not lines:
            raise UserError(
                f"{self._files[name]} holds no mask, so the size of the video is not known: write {place} with "
                "seqLength, imWidth and imHeight"
            )
        height, width = lines[0].mask["size"]  # type: ignore[misc]
        return max(line.frame for line in lines) + 1, height, width


def _lines(file: Path) -> Iterator[_Line]:
    """The masks of a file; blank lines are passed over.

    Raises:
        UserError: a line of another kind, or an id that a frame has more than once.
    """
    seen = set()
    for number, text in enumerate(file.read_text(encoding="utf-8-sig", errors="replace").splitlines(), start=1):
        if not text.strip():
            continue
        line = _parse(text, f"{file}, line {number}")
        if (line.frame, line.id) in seen:
            raise UserError(f"{line.where}: frame {line.frame + 1} has the id {line.id} more than once")
        seen.add((line.frame, line.id))
        yield line


def _parse(text: str, where: str) -> _Line:
    words = text.split()
    if text.count(",") >= 6:
        raise UserError(f"{where}: MOTChallenge boxes hold no masks and cannot be scored; write MOTS lines")
    try:
        frame, identity, kind, height, width = (int(word) for word in words[:5])
        counts = words[5]
    except (ValueError, IndexError) as error:
        raise UserError(f"{where}: want 'frame id class height width mask', got {text[:60]!r}") from error
    if identity < 1 or len(words) != 6:
        raise UserError(f"{where}: want 'frame id class height width mask' with an id from 1, got {text[:60]!r}")
    if frame < 1:
        raise UserError(f"{where}: frame {frame} is none: MOTS counts frames from 1; add 1 to all of them")
    return _Line(frame - 1, identity, kind, {"size": [height, width], "counts": counts}, where)
