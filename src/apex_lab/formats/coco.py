"""Predictions as run-length masks in JSON, in the layout of the evaluation of Weis et al. (JMLR 2021).

The file is a list of videos, each a list of frames, each `{"masks": [...], "ids": [...]}` with one mask per identity;
identities are unique over the whole file, and videos have no names: their order counts. In a file of ground truth
every frame has `num_bg` besides, the number of background masks, which are the last ones.

Masks are COCO's run-length encoding, `{"size": [height, width], "counts": "..."}`. With `runs=True` they are the
strings that the public program itself reads, "start length start length ..." over the rows of the image, counted from
1; these do not know the size of the image, so a reader has to be told.

Pixels of no mask form one more segment over the whole video; see `video.with_rest`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import Bool, Int64, Integer
from pycocotools import mask as coco

from apex_lab.base.errors import UserError
from apex_lab.formats.video import PredictedVideo, with_rest
from apex_lab.scene import ABSENT

SMALL_MASK = 5
"""The public program drops masks of so many pixels and then takes the last one left for the background."""


class CocoWriter:
    """Writes videos one at a time; the file appears under its name when all is written (`with` it).

    Args:
        path: the file.
        runs: masks as the strings of the public program.
        truth: write `PredictedVideo.truth` in place of the prediction, with `num_bg`.
    """

    def __init__(self, path: str | Path, runs: bool = False, truth: bool = False) -> None:
        self.path, self.runs, self.truth = Path(path), runs, truth
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._draft = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        self._file = open(self._draft, "w", encoding="utf-8")  # noqa: SIM115 (closed in __exit__)
        self._separator, self._offset = "[", 0

    def add(self, video: PredictedVideo) -> None:
        """Writes one video; its identities are shifted so that no other video of the file has them."""
        labels = video.truth if self.truth else video.identities
        if labels is None:
            raise ValueError(f"video {video.name!r} has no ground truth to write")
        frames = [self._frame(frame) for frame in labels]
        self._offset += int(labels.max()) + 1
        self._file.write(self._separator + json.dumps(frames))
        self._separator = ",\n"

    def _frame(self, labels: Integer[np.ndarray, "H W"]) -> dict[str, Any]:
        names, areas = np.unique(labels, return_counts=True)
        extra = {}
        if self.truth:
            # Last in the list, and left out where the public program would drop it and remove an object in its place.
            background = names == 0
            names = np.concatenate([names[~background], names[background & (areas > SMALL_MASK)]])
            extra = {"num_bg": int((names == 0).any())}
        masks = labels[None] == names[:, None, None]
        encoded = [_runs(mask) for mask in masks] if self.runs else encode(masks)
        return {"masks": encoded, "ids": [int(name) + self._offset for name in names], **extra}

    def __enter__(self) -> CocoWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.write("[]" if self._separator == "[" else "]\n")
        self._file.close()
        if kind is None:
            os.replace(self._draft, self.path)
        else:
            self._draft.unlink()


def read_coco(path: str | Path, sizes: Sequence[tuple[int, int, int]]) -> Iterator[Int64[np.ndarray, "T H W"]]:
    """Identity maps of the videos of a file, one at a time.

    Args:
        path: the file.
        sizes: (T, H, W) of every video, in order.

    Raises:
        UserError: another number of videos or frames, masks of another size or that meet, ids that repeat in a frame.
    """
    path = Path(path)
    try:
        videos = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise UserError(f"there is no file {path}") from error
    except (ValueError, OSError) as error:
        raise UserError(f"{path} is no readable JSON file ({error})") from error
    if not isinstance(videos, list) or not all(isinstance(video, list) for video in videos):
        raise UserError(f"{path} must hold a list of videos, each a list of frames")
    if len(videos) != len(sizes):
        raise UserError(f"{path} holds {len(videos)} videos, the ground truth {len(sizes)}")
    for number, (frames, shape) in enumerate(zip(videos, sizes, strict=True)):
        where = f"{path}, video {number}"
        if len(frames) != shape[0]:
            raise UserError(f"{where}: has {len(frames)} frames, the ground truth {shape[0]}")
        yield _identities(frames, shape, where)


def _identities(frames: list[Any], shape: tuple[int, int, int], where: str) -> Int64[np.ndarray, "T H W"]:
    def place(found: Int64[np.ndarray, "T H W"]) -> None:
        for t, frame in enumerate(frames):
            here = f"{where}, frame {t}"
            for name, mask in _checked(frame, here):
                pixels = decode(mask, shape[1:], here)
                if (found[t][pixels] != ABSENT).any():
                    raise UserError(f"{here}: the mask of id {name} covers pixels of another; masks must not overlap")
                found[t][pixels] = name

    return with_rest(place, shape)


def _checked(frame: Any, where: str) -> list[tuple[int, Any]]:
    """Ids and masks of one frame."""
    try:
        masks, ids = frame["masks"], frame["ids"]
        pairs = list(zip(ids, masks, strict=True))
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{where}: want {{'masks': [...], 'ids': [...]}} of one length") from error
    for name in ids:
        if type(name) is not int or name < 0:
            raise UserError(f"{where}: the id {name!r} is no integer >= 0")
        if ids.count(name) > 1:
            raise UserError(f"{where}: has the id {name} more than once; an identity can be in one place only")
    return pairs


def decode(mask: Any, size: tuple[int, int], where: str) -> Bool[np.ndarray, "H W"]:
    """One mask of either kind.

    Args:
        mask: COCO's run-length encoding, compressed or not, or a string of starts and lengths.
        size: height and width that it must have.
        where: for messages.
    """
    if isinstance(mask, str):
        return _from_runs(mask, size, where)
    try:
        height, width = mask["size"]
        counts = mask["counts"]
        lengths = np.array(_unpack(counts) if isinstance(counts, str) else counts, dtype=np.int64)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{where}: a mask is no run-length encoding ({error!r})") from error
    if (height, width) != size:
        raise UserError(f"{where}: a mask is {height} x {width}, the ground truth {size[0]} x {size[1]}")
    if lengths.ndim != 1 or (lengths < 0).any() or lengths.sum() != height * width:
        raise UserError(f"{where}: the runs of a mask do not fill its {height} x {width} pixels; it is damaged")
    # Runs of zeros and ones in turn, down the columns.
    pixels = np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
    return pixels.reshape(width, height).T


def _unpack(text: str) -> list[int]:
    """The run lengths that COCO's compressed string stands for.

    Each number is written in groups of five bits, lowest first, a sixth bit says that more follow; from the fourth
    number on, the difference to the one two before is written. (pycocotools does not notice when runs do not fill the
    image, and returns memory that nobody has written.)
    """
    lengths: list[int] = []
    number, shift = 0, 0
    for character in text:
        bits = ord(character) - 48
        if not 0 <= bits < 64:
            raise ValueError(f"{character!r} is no character of a compressed mask")
        number |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:
            number -= 1 << shift
        lengths.append(number + (lengths[-2] if len(lengths) > 2 else 0))
        number, shift = 0, 0
    if shift:
        raise ValueError("a compressed mask ends in the middle of a number")
    return lengths


def encode(masks: Bool[np.ndarray, "N H W"]) -> list[dict[str, Any]]:
    """COCO's run-length encoding of N masks."""
    encoded = coco.encode(np.asfortranarray(masks.transpose(1, 2, 0), dtype=np.uint8))
    return [{"size": list(rle["size"]), "counts": rle["counts"].decode("ascii")} for rle in encoded]


def _runs(mask: Bool[np.ndarray, "H W"]) -> str:
    """Starts (from 1, row by row) and lengths of the runs of ones."""
    edges = np.flatnonzero(np.diff(np.pad(mask.ravel().astype(np.int8), 1)))
    return " ".join(f"{start + 1} {end - start}" for start, end in edges.reshape(-1, 2).tolist())


def _from_runs(runs: str, size: tuple[int, int], where: str) -> Bool[np.ndarray, "H W"]:
    try:
        pairs = np.array([int(word) for word in runs.split()], dtype=np.int64).reshape(-1, 2)
    except ValueError as error:
        raise UserError(f"{where}: {runs[:40]!r} is no list of starts and lengths") from error
    found = np.zeros(size[0] * size[1], dtype=bool)
    for start, length in pairs.tolist():
        # Cut off silently, a mask of another image size would decode to something else.
        if start < 1 or length < 1 or start - 1 + length > len(found):
            raise UserError(
                f"{where}: a run of {length} pixels from {start} on does not lie in an image of {size[0]} x {size[1]}"
            )
        found[start - 1 : start - 1 + length] = True
    return found.reshape(size)
