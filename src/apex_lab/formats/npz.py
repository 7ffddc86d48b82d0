"""Predictions as a plain npz file, one video or many.

Arrays of a video V: `V__gt` integer (T, H, W), 0 background, one label per object; `V__masks` (T, K, H, W), soft masks
that sum to 1 over K, or one-hot; `V__ids` integer (T, K), identity of each slot, -1 for an absent slot. Other arrays
may be in the file and are passed over. Where the ground truth comes from elsewhere, `V__gt` may be missing.
"""

from __future__ import annotations

import io
import math
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import numpy as np
from jaxtyping import Int64, Integer

from apex_lab.base.errors import UserError
from apex_lab.base.faults import cited
from apex_lab.base.files import draft_of
from apex_lab.formats.bounds import check_shape
from apex_lab.formats.video import PredictedVideo, hard_segmentation, resized
from apex_lab.scene import ABSENT

PARTS = ("gt", "masks", "ids")
_DIMENSIONS = {"gt": ("T", "H", "W"), "masks": ("T", "K", "H", "W"), "ids": ("T", "K")}
_KINDS = {"gt": "ui", "masks": "fuib", "ids": "ui"}
_LEAST = {"gt": 8, "masks": 4, "ids": 8}
"""Bytes per element that scoring takes at least, whatever the file has."""
_KIND_NAMES = {"gt": "integers", "masks": "real numbers", "ids": "integers"}


_LONGEST_HEADER = 2**16
"""Bytes; NumPy's own have some hundreds at most."""


@dataclass(frozen=True)
class _Header:
    shape: tuple[int, ...]
    dtype: np.dtype


class NpzFile:
    """An npz file whose arrays are read one video at a time.

    Args:
        path: the file.
        need: parts that every video must have; the headers of all are checked here, before anything long starts.

    Raises:
        UserError: no such file, no npz file, or arrays that are missing, or of another type or shape.
    """

    def __init__(self, path: str | Path, need: tuple[str, ...] = PARTS) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise UserError(f"there is no file {self.path}")
        try:
            with zipfile.ZipFile(self.path) as archive:
                headers = {
                    name.removesuffix(".npy"): _header(archive, name)
                    for name in archive.namelist()
                    if name.endswith(".npy") and _split(name)[1] in PARTS
                }
        except Exception as error:  # what strange bytes raise has no common class
            raise UserError(
                f"{self.path} is no readable npz file ({cited(error)}); write it with numpy.savez"
            ) from error
        self.names = list(dict.fromkeys(_split(key)[0] for key in headers))
        if not self.names:
            raise UserError(
                f"{self.path} holds no video; want arrays named V__gt, V__masks and V__ids for each video V"
            )
        for name in self.names:
            self._check(name, headers, need)
        self._headers = headers

    def truth(self, name: str) -> Integer[np.ndarray, "T H W"]:
        """Ground truth of one video.

        Raises:
            UserError: damaged.
        """
        return self._read(f"{name}__gt")

    def identities(self, name: str, size: tuple[int, int] | None = None) -> Int64[np.ndarray, "T H W"]:
        """Identity of the winning slot at every pixel, with the masks brought to another size first where given.

        Raises:
            UserError: damaged, or see `hard_segmentation`.
        """
        masks, ids = self._read(f"{name}__masks"), self._read(f"{name}__ids")
        found = hard_segmentation(masks, ids, self.where(name))
        if size is None or found.shape[1:] == size:
            return found
        return hard_segmentation(resized(masks, size), ids, self.where(name))

    def size(self, name: str) -> tuple[int, int]:
        """Height and width of the masks of one video."""
        height, width = self._headers[f"{name}__masks"].shape[2:]
        return height, width

    def truth_size(self, name: str) -> tuple[int, int]:
        """Height and width of the ground truth of one video."""
        height, width = self._headers[f"{name}__gt"].shape[1:]
        return height, width

    def has_truth(self, name: str) -> bool:
        """One video comes with its ground truth."""
        return f"{name}__gt" in self._headers

    def video(self, name: str) -> PredictedVideo:
        """All that the file holds of one video."""
        return PredictedVideo(
            name,
            self.identities(name),
            truth=self.truth(name) if self.has_truth(name) else None,
            masks=self._read(f"{name}__masks"),
            ids=self._read(f"{name}__ids"),
        )

    def where(self, name: str) -> str:
        """File and video, for messages."""
        return f"{self.path}, video {name!r}"

    def _read(self, key: str) -> np.ndarray:
        try:
            with zipfile.ZipFile(self.path) as archive, archive.open(f"{key}.npy") as file:
                return np.lib.format.read_array(file, allow_pickle=False)
        except Exception as error:
            raise UserError(f"array {key} of {self.path} is damaged ({cited(error)}); write the file again") from error

    def _check(self, name: str, headers: dict[str, _Header], need: tuple[str, ...]) -> None:
        missing = [part for part in need if f"{name}__{part}" not in headers]
        if missing:
            raise UserError(f"{self.where(name)}: the array {name}__{missing[0]} is missing")
        sizes: dict[str, tuple[int, str]] = {}
        for part in PARTS:
            header = headers.get(f"{name}__{part}")
            if header is None:
                continue
            if header.dtype.kind not in _KINDS[part]:
                raise UserError(f"{self.where(name)}: {part} has the type {header.dtype}; want {_KIND_NAMES[part]}")
            if len(header.shape) != len(_DIMENSIONS[part]) or 0 in header.shape:
                wanted = ", ".join(_DIMENSIONS[part])
                raise UserError(
                    f"{self.where(name)}: {part} has the shape {header.shape}; want ({wanted}), none of it 0"
                )
            check_shape(header.shape, max(header.dtype.itemsize, _LEAST[part]), f"{self.where(name)}, {part}")
            for axis, length in zip(_DIMENSIONS[part], header.shape, strict=True):
                # The size of the images may differ on purpose, and is looked at where they meet.
                if axis in "TK" and sizes.setdefault(axis, (length, part))[0] != length:
                    known, other = sizes[axis]
                    raise UserError(
                        f"{self.where(name)}: {part} has {axis} = {length}, {other} has {axis} = {known} "
                        f"(T frames, K slots); the arrays must belong together"
                    )


def _split(key: str) -> tuple[str, str]:
    """Video and part of an array's name; no part where the name is of another kind."""
    name, separator, part = key.removesuffix(".npy").rpartition("__")
    return (name, part) if separator and name else ("", "")


def _header(archive: zipfile.ZipFile, name: str) -> _Header:
    with archive.open(name) as member:
        file = io.BytesIO(member.read(_LONGEST_HEADER))  # NumPy would read whatever length a header declares
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        stored, wanted = archive.getinfo(name).file_size - file.tell(), math.prod(shape) * dtype.itemsize
        if stored != wanted and not dtype.hasobject:
            raise ValueError(f"{name} holds {stored} bytes where its shape and type need {wanted}")
    return _Header(shape, dtype)


class NpzWriter:
    """Writes videos one at a time; the file appears under its name when all is written (`with` it)."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._draft = draft_of(self.path)
        self._archive = zipfile.ZipFile(self._draft, "w", zipfile.ZIP_DEFLATED)

    def add(self, video: PredictedVideo) -> None:
        """Writes one video: its soft masks where it has them, else one-hot masks of its segments."""
        if video.masks is not None and video.ids is not None:
            masks, ids = video.masks, video.ids
        else:
            masks, ids = one_hot(video.identities)
        parts = {"gt": video.truth, "masks": masks, "ids": ids}
        for part, array in parts.items():
            if array is not None:
                with self._archive.open(f"{video.name}__{part}.npy", "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)

    def __enter__(self) -> NpzWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._archive.close()
            if kind is None:
                os.replace(self._draft, self.path)
        finally:
            self._draft.unlink(missing_ok=True)


def one_hot(identities: Integer[np.ndarray, "T H W"]) -> tuple[np.ndarray, Int64[np.ndarray, "T K"]]:
    """Masks (T, K, H, W) of zeros and ones and ids (T, K) that say the same; -1 where an identity is not visible."""
    names = np.unique(identities).astype(np.int64)
    masks = (identities[:, None] == names[:, None, None]).astype(np.uint8)
    return masks, np.where(masks.any(axis=(2, 3)), names, ABSENT)
