"""Files that are either whole or not there: written aside, flushed to the disk, then put in place."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any

from apex_lab.base.errors import UserError
from apex_lab.base.validation import one_line, short

DRAFT = re.compile(r"\..+\.\d+\.apex_lab\.part", re.ASCII)
"""Names of files in the making. A kill leaves them; other hidden files are not ours and never removed."""


def draft_of(path: Path) -> Path:
    """Where this process writes what will stand at `path`."""
    return path.with_name(f".{path.name}.{os.getpid()}.apex_lab.part")


def drafts(folder: Path, of: str | None = None) -> list[Path]:
    """The files in the making in a folder; those of one name, if it is given. None where there is no folder."""
    found = [path for path in folder.glob(".*.apex_lab.part") if DRAFT.fullmatch(path.name) and path.is_file()]
    return [path for path in found if of is None or re.fullmatch(rf"\.{re.escape(of)}\.\d+\.apex_lab\.part", path.name)]


def clear_drafts(folder: Path, names: Iterable[str]) -> None:
    """Removes what kills in the middle of writing have left of some files, which no other process may be writing."""
    for name in names:
        for draft in drafts(folder, name):
            draft.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing(path: Path, keep: Path | None = None) -> Iterator[IO[bytes]]:
    """A file to write in place of `path`; `path` changes only when everything is on the disk.

    Args:
        path: the file.
        keep: where the file that was there before goes; None: nowhere.

    Raises:
        UserError: the disk is full or the folder cannot be written; `path` is as it was before.
    """
    part = draft_of(path)
    try:
        with open(part, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if keep is not None and path.exists():
            os.replace(path, keep)
        os.replace(part, path)
        _sync_folder(path.parent)
    except OSError as error:
        raise unwritable(path, error) from error
    except RuntimeError as error:
        # torch.save hides the operating system's error behind its own
        if isinstance(error.__context__, OSError):
            raise unwritable(path, error.__context__) from error
        raise
    finally:
        with contextlib.suppress(OSError):  # a file system without write access says so before it looks for the file
            part.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Puts a text file in place of `path`."""
    with replacing(path) as file:
        file.write(text.encode())


def write_json(path: Path, content: object) -> None:
    """Puts a JSON file in place of `path`; NaN, which JSON has not, becomes null."""
    write_text(path, json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def read_json(path: Path, advice: str = "remove it and run the same command again") -> dict[str, Any]:
    """Reads a JSON object.

    Args:
        path: the file.
        advice: what to do where it is damaged.

    Raises:
        UserError: it is missing or damaged.
    """
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{path} cannot be read ({error}): {advice}.") from error
    if not isinstance(content, dict):
        raise UserError(f"{path} holds no JSON object: {advice}.")
    return content


def fitting(key: str, pattern: Path) -> Iterator[Path]:
    """The paths that a pattern with `*` fits.

    Args:
        key: where the pattern comes from, for the message.
        pattern: relative, or from the root on.

    Raises:
        UserError: it is no pattern, or leads through folders that cannot be read.
    """
    start = Path(pattern.anchor) if pattern.is_absolute() else Path()
    try:
        yield from start.glob(str(pattern.relative_to(pattern.anchor)))
    except (ValueError, NotImplementedError) as error:
        raise UserError(
            f"{key} = {pattern} is no pattern ({error}): give paths, or a pattern such as runs/*."
        ) from error
    except OSError as error:
        raise UserError(
            f"{key} = {pattern} leads to {error.filename} ({error.strerror}): give a narrower one."
        ) from error


def set_aside(path: Path) -> Path:
    """Renames a damaged file, so that a sound one can take its place; nothing of it is lost.

    Returns:
        Its new path: `curves.damaged.csv` for `curves.csv`, with a number where that is taken.
    """
    aside = path.with_name(f"{path.stem}.damaged{path.suffix}")
    number = 2
    while aside.exists():
        aside = path.with_name(f"{path.stem}.damaged_{number}{path.suffix}")
        number += 1
    try:
        os.replace(path, aside)
    except OSError as error:
        raise unwritable(path, error) from error
    return aside


def make_folder(path: Path) -> Path:
    """Makes a folder with its parents.

    Raises:
        UserError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(path, error) from error
    return path


FULL = (errno.ENOSPC, errno.EDQUOT)
"""What a system says of a full disk, or of a user's full share of it."""


def is_full(error: OSError) -> bool:
    """Whether there is no room; other programs say so in words alone."""
    return error.errno in FULL or os.strerror(errno.ENOSPC) in str(error)


def takes_no_writes(error: BaseException | None) -> bool:
    """Whether an exception, or one that it came from, is of a disk that is full or cannot be written at all.

    Then nothing is wrong with the work at hand, and whatever comes next would fail as well.
    """
    while error is not None:
        if isinstance(error, OSError) and (is_full(error) or error.errno == errno.EROFS):
            return True
        error = error.__cause__ or error.__context__
    return False


def unwritable(path: Path, error: OSError) -> UserError:
    """The sentence for a file that could not be written."""
    if is_full(error):
        cause = "" if error.errno in (errno.ENOSPC, None) else f"{os.strerror(error.errno)}; "
        return UserError(
            f"No space left for {path} ({cause}{free_space(path)}): free some and run the same command again; "
            "nothing stored was lost."
        )
    if error.errno is None:  # an encoder's own trouble, such as want of memory; the system has refused nothing
        return UserError(f"{short(str(path))} cannot be written: {one_line(error)}.")
    why = error.strerror or one_line(error)
    return UserError(f"{short(str(path))} cannot be written ({why}): choose another folder or its permissions.")


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Inside, a file or a folder of files is written by others; their errors get its name.

    Raises:
        UserError: the disk is full, or a file there cannot be written.
    """
    try:
        yield
    except OSError as error:
        named = error.filename is not None and str(path.absolute().parent) in os.fsdecode(error.filename)
        if is_full(error) or named:
            raise unwritable(path, error) from error
        raise


def free_space(path: Path) -> str:
    """How much is free where a file is or would be, in words."""
    there = next((folder for folder in (path, *path.absolute().parents) if folder.exists()), Path())
    try:
        return f"{readable_size(shutil.disk_usage(there).free)} free there"
    except OSError as error:
        return f"what is free there cannot be told: {error.strerror}"


def readable_size(count: int) -> str:
    """Bytes in the unit a person would use."""
    for size, unit in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count} bytes"


def _sync_folder(folder: Path) -> None:
    """Makes a rename durable, where the system knows how (not on Windows)."""
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _finite(value: object) -> object:
    if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))):
        return None
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return value
