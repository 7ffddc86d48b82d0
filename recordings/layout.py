"""What the arrays of a recording look like: fields, sizes, number of items per split, and their bytes on the disk."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import xxhash

Key = tuple[str, int]
"""(split, index) of an item."""

FORMAT_VERSION = 1
"""Of folders: raised when this program could not read what it wrote before."""

HEADER_BYTES = 128


@dataclass(frozen=True)
class Field:
    """One array.

    Attributes:
        dtype: NumPy's notation with the byte order: "|u1", "<f4".
        dims: shape of one item's part; a name stands for a size of the layout, such as "T".
        meaning: for the folder's README; not part of the identity.
    """

    dtype: str
    dims: tuple[str | int, ...] = ()
    meaning: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if np.dtype(self.dtype).str != self.dtype or np.dtype(self.dtype).hasobject:
            raise ValueError(f"dtype {self.dtype!r} must be written with its byte order, as {np.dtype(self.dtype).str}")


@dataclass(frozen=True)
class Layout:
    """All arrays of a recording.

    Attributes:
        fields: name -> field; their order is that of the bytes under an item's checksum.
        counts: split -> number of items.
        sizes: name used in `Field.dims` -> size.
    """

    fields: Mapping[str, Field]
    counts: Mapping[str, int]
    sizes: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in (*self.fields, *self.counts):
            if not name.isidentifier():
                raise ValueError(f"{name!r} cannot be the name of a field or a split: letters, digits and _ only")
        for name in self.fields:
            self.shape(name)

    @property
    def splits(self) -> tuple[str, ...]:
        """Names of the splits."""
        return tuple(self.counts)

    def all_keys(self) -> list[Key]:
        """All items in storage order."""
        return [(split, index) for split, count in self.counts.items() for index in range(count)]

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of one item's part of array `name`."""
        return tuple(self.sizes[dim] if isinstance(dim, str) else dim for dim in self.fields[name].dims)

    def item_bytes(self, name: str) -> int:
        """Bytes of one item in array `name`."""
        return math.prod(self.shape(name)) * np.dtype(self.fields[name].dtype).itemsize

    def array_bytes(self, split: str, name: str) -> int:
        """Size of an array's file."""
        return HEADER_BYTES + self.counts[split] * self.item_bytes(name)

    def total_bytes(self) -> int:
        """Size of all arrays."""
        return sum(self.array_bytes(split, name) for split in self.counts for name in self.fields)

    def header(self, split: str, name: str) -> bytes:
        """The .npy header of an array: not written by NumPy, so that its bytes do not depend on NumPy's version."""
        shape = (self.counts[split], *self.shape(name))
        text = f"{{'descr': '{self.fields[name].dtype}', 'fortran_order': False, 'shape': {shape!r}, }}"
        return b"\x93NUMPY\x01\x00\x76\x00" + text.ljust(117).encode("ascii") + b"\n"

    def checksum(self, parts: Mapping[str, bytes] | Mapping[str, memoryview]) -> str:
        """Checksum (XXH3, 128 bits) of one item over all its arrays, given as field name -> raw bytes."""
        digest = xxhash.xxh3_128()
        for name in self.fields:
            digest.update(parts[name])
        return digest.hexdigest()

    def parts(self, arrays: Mapping[str, object], item: str = "item") -> dict[str, memoryview]:
        """An item's raw bytes per field, as stored on the disk.

        Args:
            arrays: field name -> array (or number, for a field without dimensions).
            item: noun for messages.

        Raises:
            ValueError: a field is missing or unknown, or an array's type or shape is not that of the layout.
        """
        if arrays.keys() != self.fields.keys():
            raise ValueError(f"{item} has the fields {sorted(arrays)}, not {sorted(self.fields)}")
        parts = {}
        for name, described in self.fields.items():
            array, wanted = np.asarray(arrays[name], order="C"), np.dtype(described.dtype)
            scalar = not described.dims and array.dtype.kind == wanted.kind
            if (array.dtype != wanted and not scalar) or array.shape != self.shape(name):
                raise ValueError(
                    f"{item} field {name} is {array.dtype.str} {array.shape}, not {wanted.str} {self.shape(name)}"
                )
            parts[name] = np.ascontiguousarray(array, dtype=wanted).reshape(-1).view(np.uint8).data
        return parts


def array_path(root: Path, split: str, name: str) -> Path:
    """Path of an array."""
    return root / split / f"{name}.npy"
