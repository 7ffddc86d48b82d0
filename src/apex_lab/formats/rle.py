"""Masks as run lengths: COCO's encoding, and the strings of the public program of Weis et al."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Int64
from pycocotools import mask as coco

from apex_lab.base.errors import UserError

UNPAINTED = int(np.iinfo(np.int64).min)
"""Stands where no mask was painted in ground truth, whose labels to ignore may be negative."""


def paint(
    labels: Int64[np.ndarray, "H W"], mask: Any, name: int, empty: int, where: str, size_of: str = "the ground truth"
) -> None:
    """Gives the pixels of one mask their name.

    Args:
        labels: of one frame; `empty` where no mask was painted yet. Changed in place.
        mask: see `decode`.
        name: what to write.
        empty: what stands where no mask was painted.
        where: file, place and id of the mask, for messages.
        size_of: what else has the size of `labels`, for messages.

    Raises:
        UserError: no mask, of another size, or over pixels of another mask.
    """
    pixels = decode(mask, (labels.shape[0], labels.shape[1]), where, size_of)
    if (labels[pixels] != empty).any():
        raise UserError(f"{where}: the mask covers pixels of another; masks must not overlap")
    labels[pixels] = name


def decode(mask: Any, size: tuple[int, int], where: str, size_of: str = "the ground truth") -> Bool[np.ndarray, "H W"]:
    """One mask of either kind.

    Args:
        mask: COCO's run-length encoding, compressed or not, or a string of starts and lengths.
        size: height and width that it must have.
        where, size_of: for messages.
    """
    if isinstance(mask, str):
        return _from_runs(mask, size, where)
    if isinstance(mask, list):
        raise UserError(f"{where}: a mask is a list, as polygons are; polygons are not read, give run-length encodings")
    try:
        height, width = mask["size"]
        counts = mask["counts"]
        if type(height) is not int or type(width) is not int:
            raise TypeError(f"its size is {mask['size']!r}, and two whole numbers are wanted")
        lengths = np.array(_unpack(counts) if isinstance(counts, str) else counts, dtype=np.int64)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise UserError(f"{where}: a mask is no run-length encoding ({error!r})") from error
    if (height, width) != size:
        raise UserError(f"{where}: a mask is {height} x {width}, {size_of} {size[0]} x {size[1]}")
    # each by itself first: a sum of large ones may come round to any number
    if (
        lengths.ndim != 1
        or ((lengths < 0) | (lengths > height * width)).any()
        or len(lengths) > 2 * height * width + 2
        or lengths.sum() != height * width
    ):
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
        if shift > 60:
            raise ValueError("a number in a compressed mask has more than 64 bits")
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


def runs(mask: Bool[np.ndarray, "H W"]) -> str:
    """Starts (from 1, row by row) and lengths of the runs of ones."""
    edges = np.flatnonzero(np.diff(np.pad(mask.ravel().astype(np.int8), 1)))
    return " ".join(f"{start + 1} {end - start}" for start, end in edges.reshape(-1, 2).tolist())


def _from_runs(text: str, size: tuple[int, int], where: str) -> Bool[np.ndarray, "H W"]:
    try:
        pairs = np.array([int(word) for word in text.split()], dtype=np.int64).reshape(-1, 2)
    except (ValueError, OverflowError) as error:
        raise UserError(f"{where}: {text[:40]!r} is no list of starts and lengths") from error
    found = np.zeros(size[0] * size[1], dtype=bool)
    for start, length in pairs.tolist():
        # Cut off silently, a mask of another image size would decode to something else.
        if start < 1 or length < 1 or start - 1 + length > len(found):
            raise UserError(
                f"{where}: a run of {length} pixels from {start} on does not lie in an image of {size[0]} x {size[1]}"
            )
        found[start - 1 : start - 1 + length] = True
    return found.reshape(size)
