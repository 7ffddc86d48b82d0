"""Looks at every video once: whether it can be read, how many frames it has, what identifies its content.

What was found is kept in a small file; a video that has not been touched since is not read again.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import xxhash

from apex_lab.base import interrupts
from apex_lab.base.errors import UserError
from apex_lab.base.files import write_json
from apex_lab.base.progress import Meter
from apex_lab.videos import find_videos, open_video
from recordings import cores

VERSION = 2
"""Raised when the same files give other results."""


@dataclass(frozen=True)
class Scanned:
    """What is known of one video.

    Attributes:
        path: the file, or the folder of pictures.
        name: relative to the folder of all videos.
        digest: 32 hex digits over the content; empty where it could not be read.
        frames: how many can be read.
        cut_off: what to say where it ends earlier than the file announces; None where it does not.
        problem: why it cannot be used; None if it can.
    """

    path: str
    name: str
    digest: str
    frames: int
    cut_off: str | None
    problem: str | None


def find(path: str) -> list[Path]:
    """The videos of a folder, a pattern or a file, in natural order.

    Raises:
        UserError: there are none, or a camera is meant.
    """
    if not any(mark in path for mark in "*?[") and not Path(path).expanduser().exists():
        raise UserError(f"data.path = {path} does not exist: give a folder of videos.")
    try:
        found = find_videos(path)
    except UserError as error:
        raise UserError(str(error).replace("video = ", "data.path = ")) from None
    except OSError as error:
        raise UserError(f"data.path = {path} cannot be read ({error.strerror}): check its permissions.") from error
    if any(isinstance(each, int) for each in found):
        raise UserError(f"data.path = {path} is a camera: record it to a file first.")
    return [each for each in found if isinstance(each, Path)]


def scan(sources: Sequence[Path], cache: Path, *, keep: bool = True) -> list[Scanned]:
    """Looks at every video, several at a time.

    Args:
        sources: files and folders of pictures.
        cache: JSON file with what was found before.
        keep: write it again.

    Raises:
        Interrupted: asked to stop; what was found until then is kept.
    """
    names = _names(sources)
    known = _read(cache)
    found: dict[str, dict[str, Any]] = {}
    stamps = {str(path): _stamp(path) for path in sources}
    left = []
    for path in sources:
        before = known.get(str(path))
        if before is not None and before["stamp"] == stamps[str(path)]:
            found[str(path)] = before
        else:
            left.append(path)
    try:
        with ThreadPoolExecutor(cores()) as threads, Meter("video looked at", len(left)) as meter:
            try:
                for done, (path, looked) in enumerate(zip(left, threads.map(_look, left), strict=True), start=1):
                    found[str(path)] = {"stamp": stamps[str(path)], **looked}
                    meter.show(done)
                    interrupts.check()
            finally:
                threads.shutdown(cancel_futures=True)
    finally:
        if left and keep:
            with suppress(UserError):  # where nothing can be written, the videos are looked at again
                cache.parent.mkdir(parents=True, exist_ok=True)
                write_json(cache, {"version": VERSION, "videos": found})
    return [
        Scanned(str(path), names[path], *(found[str(path)][key] for key in ("digest", "frames", "cut_off", "problem")))
        for path in sources
    ]


def _look(path: Path) -> dict[str, Any]:
    digest, frames, last, cut_off = "", 0, 0.0, None
    try:
        video = open_video(path)
        for frame in video.frames():
            frames, last = frames + 1, frame.time
            interrupts.check()
        cut_off = video.cut_off(frames, last)
        digest, problem = _digest(path), None
    except UserError as error:
        problem = str(error)
    except OSError as error:
        problem = f"{path} cannot be read ({error.strerror})."
    return {"digest": digest, "frames": frames, "cut_off": cut_off, "problem": problem}


def _names(sources: Sequence[Path]) -> dict[Path, str]:
    """Unique names: the paths below the folder that holds all videos."""
    root = os.path.commonpath([path.absolute().parent for path in sources])
    return {path: path.absolute().relative_to(root).as_posix() for path in sources}


def _files(path: Path) -> list[Path]:
    return sorted(each for each in path.iterdir() if each.is_file()) if path.is_dir() else [path]


def _stamp(path: Path) -> str:
    """Changes when a file is written."""
    digest = xxhash.xxh3_128()
    for file in _files(path):
        stat = file.stat()
        digest.update(f"{file.name}\0{stat.st_size}\0{stat.st_mtime_ns}\0".encode())
    return digest.hexdigest()


def _digest(path: Path) -> str:
    """Of the content; the names of pictures count, as they give the order."""
    digest = xxhash.xxh3_128()
    for file in _files(path):
        if path.is_dir():
            digest.update(f"{file.name}\0".encode())
        with open(file, "rb") as opened:
            while part := opened.read(1 << 20):
                digest.update(part)
    return digest.hexdigest()


def _read(cache: Path) -> dict[str, dict[str, Any]]:
    """What was found before; damaged entries are left out."""
    try:
        data = json.loads(cache.read_text(encoding="utf-8"))
        videos = data["videos"] if data["version"] == VERSION else {}
        return {path: entry for path, entry in videos.items() if _whole(entry)}
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return {}


def _whole(entry: Any) -> bool:
    kinds = {"stamp": str, "digest": str, "frames": int, "cut_off": str | None, "problem": str | None}
    return isinstance(entry, dict) and all(
        name in entry and isinstance(entry[name], kind) for name, kind in kinds.items()
    )
