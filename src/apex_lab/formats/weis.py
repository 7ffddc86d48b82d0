"""Predictions in the layout of the evaluation of Weis et al. (JMLR 2021).

The JSON file is a list of videos, each a list of frames, each `{"masks": [...], "ids": [...]}` with one mask per
identity; identities are unique over the whole file, and videos have no names: their order counts. Masks are the strings
that the public program reads, "start length start length ..." over the rows of the image, counted from 1. Run lengths
of COCO in their place are read too.

In a file of ground truth every frame has `num_bg` besides, the number of background masks, which are the last ones;
and, for readers of this project, `video` (the name), `size` (height, width), `labels` (the true label of each mask; 0
is the background) and, where pixels are to be ignored, `ignored` (their label and mask).

Pixels of no mask form one more segment over the whole video in a prediction (see `video.with_rest`), and belong to the
background in the ground truth.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import Int64, Integer

from apex_lab.base.errors import UserError
from apex_lab.base.files import draft_of
from apex_lab.formats.bounds import check_integer, check_shape
from apex_lab.formats.rle import UNPAINTED, paint, runs
from apex_lab.formats.video import PredictedVideo, labels_of, with_rest
from apex_lab.metrics.contingency import BACKGROUND
from apex_lab.scene import ABSENT

SMALL_MASK = 5
"""The public program drops masks of so many pixels and then takes the last one left for the background."""


class WeisWriter:
    """Writes videos one at a time; the file appears under its name when all is written (`with` it).

    Args:
        path: the file.
        truth: write `PredictedVideo.truth` in place of the prediction, with `num_bg`.
        ignore_label: pixels of this true label are in no mask of the ground truth.
    """

    def __init__(self, path: str | Path, truth: bool = False, ignore_label: int | None = None) -> None:
        self.path, self.truth, self.ignore_label = Path(path), truth, ignore_label
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._draft = draft_of(self.path)
        self._file = open(self._draft, "w", encoding="utf-8")  # noqa: SIM115 (closed in __exit__)
        self._separator, self._offset = "[", 0

    def add(self, video: PredictedVideo) -> None:
        """Writes one video; its identities are shifted so that no other video of the file has them."""
        labels = labels_of(video, self.truth)
        frames = [self._frame(frame, video.name) for frame in labels]
        self._offset += int(labels.max()) + 1
        self._file.write(self._separator + json.dumps(frames))
        self._separator = ",\n"

    def _frame(self, labels: Integer[np.ndarray, "H W"], video: str) -> dict[str, Any]:
        names, areas = np.unique(labels, return_counts=True)
        extra: dict[str, Any] = {}
        if self.truth:
            # Last in the list, and left out where the public program would drop it and remove an object in its place.
            background, ignored = names == BACKGROUND, names == self.ignore_label
            names = np.concatenate([names[~background & ~ignored], names[background & ~ignored & (areas > SMALL_MASK)]])
            extra = {"num_bg": int((names == BACKGROUND).any()), "video": video, "size": list(labels.shape)}
            extra["labels"] = names.tolist()
            if ignored.any():
                extra["ignored"] = [self.ignore_label, runs(labels == self.ignore_label)]
        masks = [runs(labels == name) for name in names]
        return {"masks": masks, "ids": [int(name) + self._offset for name in names], **extra}

    def __enter__(self) -> WeisWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            with self._file:
                self._file.write("[]" if self._separator == "[" else "]\n")
            if kind is None:
                os.replace(self._draft, self.path)
        finally:
            self._draft.unlink(missing_ok=True)


def read_weis(
    videos: Sequence[Any], path: Path, sizes: Sequence[tuple[int, int, int]]
) -> Iterator[Int64[np.ndarray, "T H W"]]:
    """Identity maps of the videos of a file, one at a time.

    Args:
        videos: content of the file.
        path: of it, for messages.
        sizes: (T, H, W) of every video, in order.

    Raises:
        UserError: another number of videos or frames, masks of another size or that meet, ids that repeat in a frame.
    """
    if not all(isinstance(video, list) for video in videos):
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
                paint(found[t], mask, name, ABSENT, f"{here}, id {name}")

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
        check_integer(name, f"{where}: an id")
        if ids.count(name) > 1:
            raise UserError(f"{where}: has the id {name} more than once; an identity can be in one place only")
    return pairs


def _labelled(frame: Any, where: str) -> list[tuple[int, Any]]:
    """Labels and masks of one frame of ground truth, that of the pixels to ignore among them."""
    pairs = _checked(frame, where)
    try:
        labels = list(frame["labels"])
        found = [(label, mask) for label, (_, mask) in zip(labels, pairs, strict=True)]
        if "ignored" in frame:
            label, mask = frame["ignored"]
            found.append((label, mask))
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{where}: want one of 'labels' for each mask, and 'ignored' as a label and a mask, where it is there"
        ) from error
    return [(check_integer(label, f"{where}: a label"), mask) for label, mask in found]


class WeisTruth:
    """Ground truth in this layout, as `WeisWriter(truth=True)` writes it.

    Args:
        videos: content of the file.
        path: of it, for messages.

    Raises:
        UserError: frames without the keys that only this project writes.
    """

    def __init__(self, videos: Sequence[Any], path: Path) -> None:
        self._path, self._videos = path, {}
        for number, frames in enumerate(videos):
            try:
                names = {frame["video"] for frame in frames}
                (name,) = names
                sizes = {tuple(frame["size"]) for frame in frames}
                ((height, width),) = sizes
                self._videos[str(name)] = (frames, (len(frames), int(height), int(width)))
            except (KeyError, TypeError, ValueError, OverflowError) as error:
                raise UserError(
                    f"{path}, video {number}: its frames do not all have the keys video, size and labels that ground "
                    "truth of this layout needs; export it again, or give the truth as npz, COCO or PNGs"
                ) from error
        if len(self._videos) < len(videos):
            raise UserError(f"{path} has a video name twice; every video needs a name of its own")
        self.names = list(self._videos)

    def labels(self, name: str) -> Int64[np.ndarray, "T H W"]:
        """True labels of one video.

        Raises:
            UserError: masks that are damaged, of another size or that overlap.
        """
        frames, shape = self._videos[name]
        check_shape(shape, 8, f"{self._path}, video {name!r}")
        found = np.full(shape, UNPAINTED, dtype=np.int64)
        for t, frame in enumerate(frames):
            where = f"{self._path}, video {name!r}, frame {t}"
            for label, mask in _labelled(frame, where):
                paint(found[t], mask, label, UNPAINTED, f"{where}, label {label}", "the frame")
        return np.where(found == UNPAINTED, BACKGROUND, found)

    def metadata(self, name: str) -> None:
        """Nothing is known."""

    def numbers(self, name: str) -> None:
        """Frames have no numbers of their own."""

    def void(self, name: str) -> int | None:
        """The label that this video marks as ignored."""
        frames, _ = self._videos[name]
        marked = ((t, frame) for t, frame in enumerate(frames) if "ignored" in frame)
        return next((_labelled(frame, f"{self._path}, video {name!r}, frame {t}")[-1][0] for t, frame in marked), None)
