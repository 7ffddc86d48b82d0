"""Takes episodes out of .tar.bz2 archives of strangers: plain files with an episode's name alone, and none outside."""

from __future__ import annotations

import bz2
import json
import shutil
import tarfile
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO

from apex_lab.base import interrupts
from apex_lab.base.errors import UserError
from apex_lab.base.files import drafts, make_folder, replacing, write_json
from apex_lab.base.progress import Meter
from apex_lab.data.sketchy.files import ARCHIVE, EPISODE
from apex_lab.data.sketchy.tfrecord import DamagedFileError

DONE = ".extracted.json"
"""File in the folder of an archive: what came out of it. Without this file, extraction was interrupted."""

CHUNK = 2**20


@dataclass(frozen=True)
class Extracted:
    """What came out of an archive.

    Attributes:
        size, time: of the archive: bytes, and nanoseconds of its last change.
        episodes: names of the files.
        problem: why there are not more; None for a sound archive.
    """

    size: int
    time: int
    episodes: list[str]
    problem: str | None


class _Refused(Exception):
    """An archive with content that no archive of episodes has."""


class _Stopped(Exception):
    """Another archive failed, or the program was asked to stop."""


def extract_all(archives: Sequence[Path], folder: Path, workers: int) -> tuple[dict[str, Path], list[str]]:
    """Extracts archives, several at a time; what has been extracted before is kept.

    Args:
        archives: the archives.
        folder: gets a folder for each archive.
        workers: threads (decompression runs without Python's lock).

    Returns:
        Episode's name -> file, and a sentence for each archive that is damaged or refused.

    Raises:
        UserError: Python is too old to look through archives safely, or the disk is full.
    """
    if archives and not hasattr(tarfile, "data_filter"):
        raise UserError("Reading archives safely needs Python 3.11.4 or later: install it, or extract them by tar.")
    stopped = threading.Event()
    pool = ThreadPoolExecutor(workers)
    found: dict[Path, Extracted] = {}
    try:
        with Meter("archive", len(archives)) as meter:
            futures = {pool.submit(_extract, archive, folder, stopped): archive for archive in archives}
            for done, future in enumerate(as_completed(futures), start=1):
                found[futures[future]] = future.result()
                meter.show(done)
                interrupts.check()
    finally:
        stopped.set()
        pool.shutdown(cancel_futures=True)
    episodes: dict[str, Path] = {}
    for archive in archives:
        for name in found[archive].episodes:
            episodes.setdefault(name, _place(archive, folder) / name)
    return episodes, [f"{archive.name}: {found[archive].problem}" for archive in archives if found[archive].problem]


def _place(archive: Path, folder: Path) -> Path:
    return folder / archive.name.removesuffix(ARCHIVE)


def _extract(archive: Path, folder: Path, stopped: threading.Event) -> Extracted:
    place = make_folder(_place(archive, folder))
    with _readable(archive):
        status = archive.stat()
    before = _extracted_before(place)
    if before is not None and (before.size, before.time) == (status.st_size, status.st_mtime_ns):
        return before
    for left in drafts(place):
        left.unlink(missing_ok=True)
    episodes: list[str] = []
    problem = None
    try:
        for name in _members(archive, place, stopped):
            episodes.append(name)
    except _Refused as refused:
        shutil.rmtree(place)
        make_folder(place)
        episodes, problem = [], f"{refused}, so nothing of it is used"
    except DamagedFileError as damage:
        problem = f"{damage} after {len(episodes)} episodes, which are used"
    outcome = Extracted(status.st_size, status.st_mtime_ns, sorted(set(episodes)), problem)
    write_json(place / DONE, asdict(outcome))
    return outcome


def _extracted_before(place: Path) -> Extracted | None:
    """The outcome of an earlier extraction whose files are all there."""
    try:
        before = Extracted(**json.loads((place / DONE).read_text()))
        whole = all((place / name).is_file() for name in before.episodes)
    except (OSError, ValueError, TypeError, RecursionError):
        return None
    return before if whole else None


def _members(archive: Path, place: Path, stopped: threading.Event) -> Iterator[str]:
    """Extracts one episode after the other; yields their names.

    Raises:
        DamagedFileError: the archive is cut off or damaged.
        _Refused: a member is no plain file, or leads outside.
        _Stopped: by the caller.
        UserError: a file cannot be written.
    """
    with _readable(archive), bz2.open(archive) as source, tarfile.open(fileobj=source, mode="r|") as tar:
        for member in iter(tar.next, None):
            _refuse(member, place)
            name = Path(member.name).name
            if not member.isfile() or not EPISODE.fullmatch(name):
                continue
            if not (place / name).exists() or (place / name).stat().st_size != member.size:
                with replacing(place / name) as file:
                    _copy(tar, member, file, stopped)
            yield name
        while source.read(CHUNK):  # to the end, where the last checksum of the compression is
            pass


@contextmanager
def _readable(archive: Path) -> Iterator[None]:
    """Tells damage of an archive from what keeps it from being read."""
    try:
        yield
    except (tarfile.TarError, EOFError):
        raise DamagedFileError("it is cut off or damaged") from None
    except OSError as error:
        if error.errno is None:  # of the compression
            raise DamagedFileError("it is cut off or damaged") from None
        raise UserError(
            f"{archive} cannot be read ({error.strerror}): change its permissions, or check that disk."
        ) from None


def _refuse(member: tarfile.TarInfo, place: Path) -> None:
    """Looks at a member before anything of it is written."""
    if not (member.isfile() or member.isdir()):
        raise _Refused(f"it holds {member.name!r}, which is no plain file")
    try:
        filtered = tarfile.data_filter(member, str(place))
    except tarfile.FilterError:
        raise _Refused(f"it holds {member.name!r}, which leads outside") from None
    if filtered.name != member.name:  # the filter turns absolute names into relative ones
        raise _Refused(f"it holds {member.name!r}, which leads outside")


def _copy(tar: tarfile.TarFile, member: tarfile.TarInfo, file: IO[bytes], stopped: threading.Event) -> None:
    source = tar.extractfile(member)
    assert source is not None
    left = member.size
    while left:
        if stopped.is_set():
            raise _Stopped
        try:
            chunk = source.read(min(CHUNK, left))
        except OSError as error:  # the file being written is not to blame
            raise tarfile.ReadError(str(error)) from error
        if not chunk:
            raise tarfile.ReadError("unexpected end of data")
        file.write(chunk)
        left -= len(chunk)
