"""Files of a recording: reserving their space, writing items in place, small files at once."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from recordings.errors import RecordingError
from recordings.layout import HEADER_BYTES, Layout, array_path

MARGIN_BYTES = 1 << 20
"""Space reserved for the small files of a folder."""


class Arrays:
    """The open files of one split, for reading and writing whole items by position.

    Positioned reads and writes instead of a memory map: a full or failing disk is then an `OSError`, not a signal that
    ends the process.
    """

    def __init__(self, root: Path, split: str, layout: Layout, *, writable: bool = False) -> None:
        self.layout = layout
        self.sizes = {name: layout.item_bytes(name) for name in layout.fields}
        self.files: dict[str, int] = {}
        flags = os.O_RDWR if writable else os.O_RDONLY
        try:
            for name in layout.fields:
                self.files[name] = os.open(array_path(root, split, name), flags)
        except OSError:
            self.close()
            raise

    def write(self, index: int, parts: Mapping[str, memoryview]) -> None:
        """Writes one item at its position."""
        for name, file in self.files.items():
            part, offset = parts[name], HEADER_BYTES + index * self.sizes[name]
            while len(part):
                written = os.pwrite(file, part, offset)
                part, offset = part[written:], offset + written

    def checksum(self, index: int) -> str:
        """Checksum of one item on the disk; raises `OSError` if it cannot be read."""
        parts = {
            name: _read(file, self.sizes[name], HEADER_BYTES + index * self.sizes[name])
            for name, file in self.files.items()
        }
        return self.layout.checksum(parts)

    def sync(self) -> None:
        """Syncs all written bytes to the disk."""
        for file in self.files.values():
            os.fsync(file)

    def close(self) -> None:
        """Closes all files."""
        for file in self.files.values():
            os.close(file)
        self.files = {}


def _read(file: int, size: int, offset: int) -> bytes:
    """`size` bytes, fewer at the end of the file; one call reads at most 2 GiB."""
    part = os.pread(file, size, offset)
    if len(part) in (0, size):
        return part
    return part + _read(file, size - len(part), offset + len(part))


def check_room(root: Path, layout: Layout, name: str) -> None:
    """Compares the space that the arrays still need with the free space of the disk.

    Raises:
        RecordingError: the disk has too little free space; `name` says for what.
    """
    room = MARGIN_BYTES + _missing_bytes(root, layout)
    free = shutil.disk_usage(root).free
    if room > free:
        raise RecordingError(
            f"{name} needs {_size(room)} more at {root} but only {_size(free)} are free there: "
            "free some space or choose another folder"
        )


def allocate(root: Path, layout: Layout, name: str) -> None:
    """Gives every array its header and final size and reserves its space; existing content stays.

    Raises:
        RecordingError: the disk has too little free space.
    """
    check_room(root, layout, name)
    for split in layout.splits:
        (root / split).mkdir(exist_ok=True)
        for field in layout.fields:
            path, size = array_path(root, split, field), layout.array_bytes(split, field)
            file = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
            try:
                os.ftruncate(file, size)
                _reserve(file, size)
                os.pwrite(file, layout.header(split, field), 0)
            except OSError as error:
                raise no_room(error, path) from error
            finally:
                os.close(file)


def allocate_or_leave_nothing(root: Path, layout: Layout, name: str) -> None:
    """As `allocate`, for a folder without finished items; removes the arrays if their space cannot be reserved."""
    try:
        allocate(root, layout, name)
    except RecordingError:
        for split in layout.splits:  # empty arrays would only take up space on a full disk
            for field in layout.fields:
                array_path(root, split, field).unlink(missing_ok=True)
            with suppress(OSError):  # not there, or somebody put a file there
                (root / split).rmdir()
        raise


def no_room(error: OSError, path: Path | str) -> RecordingError:
    """The error for a failed write."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    remedy = "free space on that disk" if full else "check that disk"
    room = f"; {_free(Path(path))} free there" if full else ""
    return RecordingError(
        f"writing {path} failed ({os.strerror(error.errno or 0)}{room}): {remedy} and run the same command again; "
        "all that is finished is kept"
    )


def _free(path: Path) -> str:
    there = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    return _size(shutil.disk_usage(there).free)


def write_at_once(path: Path, text: str) -> None:
    """Writes a small file atomically and syncs it to the disk."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(draft, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_folder(path: Path) -> None:
    """Syncs a folder's entries to the disk."""
    folder = os.open(path, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


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


def _missing_bytes(root: Path, layout: Layout) -> int:
    missing = 0
    for split in layout.splits:
        for name in layout.fields:
            path = array_path(root, split, name)
            taken = path.stat().st_blocks * 512 if path.exists() else 0
            missing += max(layout.array_bytes(split, name) - taken, 0)
    return missing


def _size(count: int) -> str:
    return f"{count / 1e9:.2f} GB" if count >= 1e7 else f"{count / 1e6:.2f} MB"
