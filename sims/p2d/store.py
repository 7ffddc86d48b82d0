"""Layout of the P2D folder: memory-mappable arrays, a journal line per finished trajectory, a manifest at the end.

```
<root>/manifest.json        written last, atomically: a folder without it is unfinished
<root>/trajectories.jsonl   first line: settings and facts; then one line with a checksum per finished trajectory
<root>/<split>/<field>.npy  one array per field of `Trajectory`, first axis the trajectory
```

Every array has its final size from the start and trajectories are written in place, so several processes can write at
once. A trajectory counts as finished only when its line is in `trajectories.jsonl`. Resuming first checks all lines
against the arrays: after a kill or a power cut, trajectories that do not match their checksum are generated again.
Hence nothing needs to be synced to the disk before the end.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xxhash

from sims.errors import SimError
from sims.p2d.settings import Settings
from sims.p2d.trajectory import Trajectory

FORMAT_VERSION = 1
SPLITS = ("train", "val", "test")

Key = tuple[str, int]
"""(split, index) of a trajectory."""


@dataclass(frozen=True)
class Field:
    """Type of one array and its shape per trajectory; T frames, S image size, O object slots."""

    dtype: str
    dims: tuple[str | int, ...]


FIELDS: dict[str, Field] = {
    "rgb": Field("|u1", ("T", "S", "S", 3)),
    "segmentation": Field("|u1", ("T", "S", "S")),
    "depth": Field("<f2", ("T", "S", "S")),
    "classes": Field("<i2", ("O",)),
    "poses": Field("<f4", ("T", "O", 7)),
    "joints": Field("<f4", ("T", 9)),
    "gripper": Field("<f4", ("T", 7)),
    "visible_px": Field("<i4", ("T", "O+1")),
    "amodal_px": Field("<i4", ("T", "O+1")),
    "arm_contact": Field("|b1", ("T", "O")),
    "object_contact": Field("|b1", ("T", "O", "O")),
    "aimed": Field("|b1", ()),
    "redraws": Field("<i4", ()),
}


def counts(settings: Settings) -> dict[str, int]:
    """Number of trajectories per split."""
    return {split: getattr(settings, split) for split in SPLITS}


def keys(settings: Settings) -> list[Key]:
    """All trajectories of a data set in storage order."""
    return [(split, index) for split, count in counts(settings).items() for index in range(count)]


def item_shape(settings: Settings, name: str) -> tuple[int, ...]:
    """Shape of one trajectory's part of array `name`."""
    sizes = {
        "T": settings.frames,
        "S": settings.image_size,
        "O": settings.max_objects,
        "O+1": settings.max_objects + 1,
    }
    return tuple(sizes[dim] if isinstance(dim, str) else dim for dim in FIELDS[name].dims)


def item_bytes(settings: Settings, name: str) -> int:
    """Bytes of one trajectory in array `name`."""
    return int(np.prod(item_shape(settings, name), dtype=np.int64)) * np.dtype(FIELDS[name].dtype).itemsize


def header(settings: Settings, split: str, name: str) -> bytes:
    """The .npy header of an array: not written by NumPy, so that its bytes do not depend on NumPy's version."""
    shape = (counts(settings)[split], *item_shape(settings, name))
    text = f"{{'descr': '{FIELDS[name].dtype}', 'fortran_order': False, 'shape': {shape!r}, }}"
    return b"\x93NUMPY\x01\x00\x76\x00" + text.ljust(117).encode("ascii") + b"\n"


HEADER_BYTES = 128

MARGIN_BYTES = 1 << 20
"""Space reserved for the small files of a folder."""


def array_path(root: Path, split: str, name: str) -> Path:
    """Path of an array."""
    return root / split / f"{name}.npy"


def array_bytes(settings: Settings, split: str, name: str) -> int:
    """Size of an array's file."""
    return HEADER_BYTES + counts(settings)[split] * item_bytes(settings, name)


def total_bytes(settings: Settings) -> int:
    """Size of all arrays of a data set."""
    return sum(array_bytes(settings, split, name) for split in SPLITS for name in FIELDS)


def checksum(parts: Mapping[str, bytes] | Mapping[str, memoryview]) -> str:
    """Checksum (XXH3, 128 bits) of one trajectory over all its arrays, given as field name -> raw bytes."""
    digest = xxhash.xxh3_128()
    for name in FIELDS:
        digest.update(parts[name])
    return digest.hexdigest()


def to_parts(settings: Settings, trajectory: Trajectory) -> dict[str, memoryview]:
    """A trajectory's raw bytes per field, as stored on the disk.

    Raises:
        ValueError: an array's type or shape differs from `FIELDS` and the settings.
    """
    parts = {}
    for name, field in FIELDS.items():
        array = np.asarray(getattr(trajectory, name), order="C")
        scalar = not field.dims and array.dtype.kind == np.dtype(field.dtype).kind
        if (array.dtype != np.dtype(field.dtype) and not scalar) or array.shape != item_shape(settings, name):
            wanted = f"{field.dtype} {item_shape(settings, name)}"
            raise ValueError(f"trajectory field {name} is {array.dtype.str} {array.shape}, not {wanted}")
        parts[name] = np.ascontiguousarray(array, dtype=field.dtype).reshape(-1).view(np.uint8).data
    return parts


class Arrays:
    """The open files of one split, for reading and writing whole trajectories by position.

    Positioned reads and writes instead of a memory map: a full or failing disk is then an `OSError`, not a signal that
    ends the process.
    """

    def __init__(self, root: Path, split: str, settings: Settings, *, writable: bool = False) -> None:
        self.settings = settings
        self.sizes = {name: item_bytes(settings, name) for name in FIELDS}
        self.files: dict[str, int] = {}
        flags = os.O_RDWR if writable else os.O_RDONLY
        try:
            for name in FIELDS:
                self.files[name] = os.open(array_path(root, split, name), flags)
        except OSError:
            self.close()
            raise

    def write(self, index: int, parts: Mapping[str, memoryview]) -> None:
        """Writes one trajectory at its position."""
        for name, file in self.files.items():
            part, offset = parts[name], HEADER_BYTES + index * self.sizes[name]
            while len(part):
                written = os.pwrite(file, part, offset)
                part, offset = part[written:], offset + written

    def checksum(self, index: int) -> str:
        """Checksum of one trajectory on the disk; raises `OSError` if it cannot be read."""
        parts = {
            name: os.pread(file, self.sizes[name], HEADER_BYTES + index * self.sizes[name])
            for name, file in self.files.items()
        }
        return checksum(parts)

    def sync(self) -> None:
        """Syncs all written bytes to the disk."""
        for file in self.files.values():
            os.fsync(file)

    def close(self) -> None:
        """Closes all files."""
        for file in self.files.values():
            os.close(file)
        self.files = {}


def check_room(root: Path, settings: Settings) -> None:
    """Compares the space that the arrays still need with the free space of the disk.

    Raises:
        SimError: the disk has too little free space.
    """
    room = MARGIN_BYTES + _missing_bytes(root, settings)
    free = shutil.disk_usage(root).free
    if room > free:
        raise SimError(
            f"P2D needs {_size(room)} more at {root} but only {_size(free)} are free there: "
            "free some space or choose another folder"
        )


def allocate(root: Path, settings: Settings) -> None:
    """Gives every array its header and final size and reserves its space; existing content stays.

    Raises:
        SimError: the disk has too little free space.
    """
    check_room(root, settings)
    for split in SPLITS:
        (root / split).mkdir(exist_ok=True)
        for name in FIELDS:
            path, size = array_path(root, split, name), array_bytes(settings, split, name)
            file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
            try:
                os.ftruncate(file, size)
                _reserve(file, size)
                os.pwrite(file, header(settings, split, name), 0)
            except OSError as error:
                raise no_room(error, path) from error
            finally:
                os.close(file)


def no_room(error: OSError, path: Path | str) -> SimError:
    """The error for a failed write."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    remedy = "free space on that disk" if full else "check that disk"
    return SimError(
        f"writing {path} failed ({os.strerror(error.errno or 0)}): {remedy} and run the same command again; "
        "all finished trajectories are kept"
    )


def _reserve(file: int, size: int) -> None:
    """Reserves a file's space, so that a full disk is found before the work and not during it."""
    reserve: Callable[[int, int, int], None] | None = getattr(os, "posix_fallocate", None)
    if reserve is None:  # macOS
        return
    try:
        reserve(file, 0, size)
    except OSError as error:
        if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):  # some file systems cannot reserve
            raise


def _missing_bytes(root: Path, settings: Settings) -> int:
    missing = 0
    for split in SPLITS:
        for name in FIELDS:
            path = array_path(root, split, name)
            taken = path.stat().st_blocks * 512 if path.exists() else 0
            missing += max(array_bytes(settings, split, name) - taken, 0)
    return missing


def _size(count: int) -> str:
    return f"{count / 1e9:.2f} GB" if count >= 1e7 else f"{count / 1e6:.2f} MB"
