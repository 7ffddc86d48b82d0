"""What a folder holds: episode files, archives of them, and how an episode is checked before it is used."""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from apex_lab.base import interrupts
from apex_lab.base.errors import UserError
from apex_lab.base.files import unwritable
from apex_lab.base.progress import Meter
from apex_lab.data.sketchy.example import read_features
from apex_lab.data.sketchy.tfrecord import DamagedFileError, Records
from apex_lab.data.sketchy.views import CAMERAS, HEIGHT, WIDTH, decoded, open_image

EPISODE = re.compile(r"\d+_[0-9a-fA-F]{8}(-[0-9a-fA-F]{4}){3}-[0-9a-fA-F]{12}", re.ASCII)
"""Names of episode files: digits, an underscore, a UUID, no extension."""

ARCHIVE = ".tar.bz2"

_PART = re.compile(r"(.+)-(\d{5})-of-(\d{5})\.tar\.bz2", re.ASCII)

CHECKED = "sketchy_checked.jsonl"
"""What has been checked before, so that it is read once: a line per file with its size and time."""


@dataclass(frozen=True)
class Found:
    """The content of a folder and its sub-folders, in the order of names.

    Attributes:
        episodes: name -> file.
        archives: the archives.
        remarks: a sentence each on episodes that are there twice and archives that are missing.
    """

    episodes: dict[str, Path]
    archives: list[Path]
    remarks: list[str]


def find(folder: Path) -> Found:
    """Looks for episodes and archives in a folder.

    Raises:
        UserError: there is no such folder, or nothing in it.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is not a folder: name the one that holds the episodes or their archives.")
    episodes: dict[str, Path] = {}
    archives, twice = [], []
    for path in _files(folder):
        if path.name.endswith(ARCHIVE):
            archives.append(path)
        elif EPISODE.fullmatch(path.name):
            if path.name in episodes:
                twice.append(path)
            episodes.setdefault(path.name, path)
    if not episodes and not archives:
        raise UserError(
            f"{folder} holds neither episodes (files named <digits>_<UUID>) nor archives (*{ARCHIVE}): "
            "python -m apex_lab.data.sketchy --help says how to get them."
        )
    remarks = [f"{path} is left out: {path.name} is there twice." for path in twice]
    return Found(dict(sorted(episodes.items())), archives, [*remarks, *_missing_parts(archives)])


def _files(folder: Path) -> list[Path]:
    """All files below a folder but hidden ones, in the order of names; links to folders are not followed.

    Links that lead nowhere are among them: an episode that is missing is named as one that cannot be read.
    """

    def refuse(error: OSError) -> None:
        raise UserError(f"{error.filename} cannot be read ({error.strerror}): change its permissions.") from error

    found = []
    for parent, folders, names in os.walk(folder, onerror=refuse):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        found += [Path(parent, name) for name in sorted(names) if not name.startswith(".")]
    return [path for path in found if path.is_file() or not path.exists()]


def _missing_parts(archives: Sequence[Path]) -> list[str]:
    """A sentence for each subset of which some archives are there and others are not."""
    there: dict[tuple[str, int], set[int]] = {}
    for path in archives:
        part = _PART.fullmatch(path.name)
        if part:
            there.setdefault((part[1], int(part[3])), set()).add(int(part[2]))
    sentences = []
    for (subset, count), numbers in sorted(there.items()):
        missing = [f"{number:05d}" for number in range(count) if number not in numbers]
        if missing:
            sentences.append(
                f"{subset}: {len(missing)} of {count} archives are missing ({_few(missing)}); with them the split by "
                "names will be another one."
            )
    return sentences


def _few(names: Sequence[str], most: int = 5) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def check_episode(path: Path) -> int:
    """Reads a whole episode: checksums, and the front cameras' images of every timestep.

    Returns:
        The number of its timesteps.

    Raises:
        DamagedFileError: what is wrong with it.
        OSError: it cannot be read.
    """
    with Records(path) as records:
        if not len(records):
            raise DamagedFileError("it is empty")
        for timestep in range(len(records)):
            for image in front_images(records, timestep).values():
                with _at(timestep, "image"):
                    # luminance at an eighth of the size: all of the file is decoded in a third of the time
                    image.draft("L", (WIDTH // 8, HEIGHT // 8))
                    decoded(image)
        return len(records)


def front_images(records: Records, timestep: int) -> dict[str, Image.Image]:
    """Images of the front cameras at a timestep, pixels not yet decoded: camera's short name -> image.

    Raises:
        DamagedFileError: an image is missing, no JPEG or not 600 x 960 in colour; names timestep and feature.
    """
    payload = records[timestep]
    with _at(timestep, "record"):
        features = read_features(payload, set(CAMERAS.values()))
    images = {}
    for camera, feature in CAMERAS.items():
        with _at(timestep, feature):
            values = features.get(feature)
            if values is None:
                raise DamagedFileError("it is missing")
            if not isinstance(values, list) or len(values) != 1:
                raise DamagedFileError("not one string of bytes")
            images[camera] = open_image(values[0])
    return images


@contextmanager
def _at(timestep: int, what: str) -> Iterator[None]:
    """Adds the place to what is wrong there."""
    try:
        yield
    except DamagedFileError as error:
        raise DamagedFileError(f"{what} of timestep {timestep}: {error}") from None


@dataclass(frozen=True)
class Checks:
    """The outcome for every episode.

    Attributes:
        timesteps: name -> how many, of sound episodes.
        problems: name -> what is wrong with it.
    """

    timesteps: dict[str, int]
    problems: dict[str, str]


def check_all(episodes: dict[str, Path], notes: Path, workers: int) -> Checks:
    """Checks all episodes, several at a time; what was checked before is not read again.

    Args:
        episodes: name -> file.
        notes: folder where outcomes are kept.
        workers: threads (reading, checksums and decoding run without Python's lock).

    Raises:
        UserError: outcomes cannot be written down.
    """
    log = _Log(notes / CHECKED)
    known = {name: log.outcome(path) for name, path in episodes.items()}
    left = {name: path for name, path in episodes.items() if known[name] is None}
    pool = ThreadPoolExecutor(workers)
    try:
        with Meter("episode checked", len(episodes), len(episodes) - len(left)) as meter:
            futures = {pool.submit(_outcome, path): name for name, path in left.items()}
            for done, future in enumerate(as_completed(futures), start=len(episodes) - len(left) + 1):
                name = futures[future]
                known[name] = log.add(left[name], future.result())
                meter.show(done)
                interrupts.check()
    finally:
        pool.shutdown(cancel_futures=True)
    timesteps = {name: outcome for name, outcome in known.items() if isinstance(outcome, int)}
    return Checks(timesteps, {name: outcome for name, outcome in known.items() if isinstance(outcome, str)})


Outcome = int | str
"""Timesteps, or what is wrong."""


def _outcome(path: Path) -> Outcome:
    try:
        return check_episode(path)
    except DamagedFileError as error:
        return str(error)
    except OSError as error:
        return f"it cannot be read ({error.strerror or error})"


class _Log:
    """Outcomes of checks by file; a line that cannot be read is a check that is made again."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._known: dict[tuple[str, int, int], Outcome] = {}
        with contextlib.suppress(FileNotFoundError):
            for line in path.read_bytes().splitlines():
                with contextlib.suppress(ValueError, KeyError, TypeError):
                    entry = json.loads(line)
                    self._known[entry["file"], entry["size"], entry["time"]] = entry["outcome"]

    def outcome(self, path: Path) -> Outcome | None:
        """What was found before, if the file is still the same."""
        return self._known.get(_state(path))

    def add(self, path: Path, outcome: Outcome) -> Outcome:
        """Keeps an outcome, but for files that could not be read: that may pass."""
        if not (isinstance(outcome, str) and outcome.startswith("it cannot be read")):
            name, size, time = _state(path)
            line = json.dumps({"file": name, "size": size, "time": time, "outcome": outcome})
            try:
                with open(self._path, "a", encoding="utf-8") as file:
                    file.write(line + "\n")
            except OSError as error:
                raise unwritable(self._path, error) from error
        return outcome


def _state(path: Path) -> tuple[str, int, int]:
    """What tells a file from its later versions."""
    try:
        status = path.stat()
    except OSError:
        return str(path.absolute()), -1, -1
    return str(path.absolute()), status.st_size, status.st_mtime_ns
