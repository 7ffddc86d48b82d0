"""The plain values of a checkpoint without its tensors, some ten times as fast as reading it, and without PyTorch.

A checkpoint is a zip archive: one pickle of the dictionary, and one file per tensor's storage. Unpickling runs code
only by calling what it finds by name; here every name leads to a class that does nothing or notes where a tensor lies,
so the values in a file of a stranger can be looked at. What is built from a file is read by
`torch.load(..., weights_only=True)` all the same.
"""

from __future__ import annotations

import hashlib
import io
import math
import pickle
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

_BYTES = {
    **{"DoubleStorage": 8, "FloatStorage": 4, "HalfStorage": 2, "BFloat16Storage": 2},
    **{"LongStorage": 8, "IntStorage": 4, "ShortStorage": 2, "CharStorage": 1, "ByteStorage": 1, "BoolStorage": 1},
}
"""PyTorch's name of a storage -> bytes of an element."""


@dataclass(frozen=True)
class Placed:
    """Where a tensor lies in a checkpoint.

    Attributes:
        storage: PyTorch's name for storages of its type, such as FloatStorage.
        part: name of the file with its storage.
        offset: elements of the storage before it.
        size, stride: as of the tensor, in elements.
    """

    storage: str
    part: str
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]


def outline(path: Path) -> Any:
    """What was saved, with a `Placed` for every tensor, and an empty object for anything else that is no plain value.

    Raises:
        Exception: of any class, where the file is damaged.
    """

    class Nothing:
        """Takes anything and does nothing."""

        def __init__(self, *_: object, **__: object) -> None:
            pass

    class Ordered(dict[Any, Any]):
        """Stands for `OrderedDict`, which PyTorch gives attributes."""

    def placed(storage: tuple[str, str], offset: int, size: Any, stride: Any, *_: object) -> Placed:
        return Placed(*storage, offset, tuple(size), tuple(stride))

    class Unpickler(pickle.Unpickler):
        def find_class(self, module: str, name: str) -> Any:
            if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
                return placed
            if module == "torch" and name in _BYTES:
                return name
            return Ordered if (module, name) == ("collections", "OrderedDict") else Nothing

        def persistent_load(self, about: Any) -> tuple[str, str]:
            _, storage, part, *_ = about
            return storage, part

    with zipfile.ZipFile(path) as archive:
        return Unpickler(io.BytesIO(archive.read(_pickle(archive)))).load()


def _pickle(archive: zipfile.ZipFile) -> str:
    """The one name of the pickle in a checkpoint."""
    (name,) = [name for name in archive.namelist() if name.endswith("/data.pkl")]
    return name


def digest(path: Path, weights: Mapping[str, Placed]) -> str:
    """SHA-256 of weights: of their names, types, sizes and values, in the order of their names.

    Files that hold the same weights have the same digest, whatever else is in them.

    Args:
        path: the checkpoint.
        weights: name -> place, from its outline.

    Raises:
        Exception: of any class, where the file is damaged.
    """
    found = hashlib.sha256()
    with zipfile.ZipFile(path) as archive:
        folder = _pickle(archive).removesuffix("data.pkl")
        for name, place in sorted(weights.items()):
            found.update(f"{name} {place.storage} {place.size}\n".encode())
            found.update(_values(archive.read(f"{folder}data/{place.part}"), place))
    return found.hexdigest()


def _values(storage: bytes, place: Placed) -> bytes:
    """The bytes of a tensor's elements in the order of its dimensions."""
    each = _BYTES[place.storage]
    if min((*place.size, *place.stride, place.offset), default=0) < 0 or len(place.size) != len(place.stride):
        raise ValueError("no tensor can lie so")
    if math.prod(place.size) == 0:
        return b""
    last = place.offset + sum((size - 1) * stride for size, stride in zip(place.size, place.stride, strict=True))
    if (last + 1) * each > len(storage) or math.prod(place.size) * each > len(storage):
        raise ValueError("a tensor reaches beyond its storage")
    start = np.frombuffer(storage, dtype=f"V{each}", offset=place.offset * each)
    strides = [stride * each for stride in place.stride]
    return np.lib.stride_tricks.as_strided(start, place.size, strides, writeable=False).tobytes()
