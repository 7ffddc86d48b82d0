"""From a folder of episodes or archives to a recording: extract, check, split by name, cut windows, resize, store."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, unwritable
from apex_lab.data.sketchy.archives import extract_all
from apex_lab.data.sketchy.files import Checks, check_all, find
from apex_lab.data.sketchy.recording import KIND, Episode, Timesteps, plan, recording_folder
from apex_lab.data.sketchy.split import SPLITS, split_by_name
from recordings import MANIFEST, Manifest, Plan, RecordingError, cores, read_journal, read_manifest, record, repair

EXTRACTED = "sketchy_episodes"
"""Folder of the episodes that come out of archives."""


@dataclass(frozen=True)
class Request:
    """What to prepare.

    Attributes:
        folder: with episodes, or archives of them, in it or in its sub-folders.
        root: gets the recording, the extracted episodes and the notes of checks.
        name: of the recording.
        image_size: height and width of its images in pixels.
        windows: names out of `views.WINDOWS`.
        workers: processes and threads; None: one per core; 1: this process alone makes the recording.
    """

    folder: Path
    root: Path
    name: str
    image_size: int
    windows: tuple[str, ...]
    workers: int | None = None

    @property
    def processes(self) -> int | None:
        """Processes besides this one that make the recording; None: one per core."""
        return 0 if self.workers == 1 else self.workers

    @property
    def recording(self) -> Path:
        """The folder of the recording."""
        return recording_folder(self.root.absolute(), self.name, self.image_size)


def prepare(request: Request) -> Manifest[dict[str, Any]]:
    """Makes a recording, or resumes one that was interrupted; says what is left out and why.

    Raises:
        UserError: there is no sound episode, the recording is there with other episodes or settings, or the disk is
            full; what is finished is kept.
    """
    episodes, checks, wanted = _planned(request)
    _refuse_other(request, wanted)
    maker = Timesteps(wanted.settings, episodes, checks.problems)
    try:
        return record(request.recording, wanted, maker, workers=request.processes)
    except RecordingError as error:
        raise UserError(str(error)) from error


def repair_recording(request: Request) -> list[str]:
    """Compares a finished recording with its checksums and makes what is damaged again; returns a line per damage.

    Raises:
        UserError: there is no such recording, the episodes that it needs are missing or have changed, or disk trouble.
    """
    try:
        read_manifest(request.recording, KIND)
    except RecordingError as error:
        if not (request.recording / KIND.journal).is_file():
            raise UserError(str(error)) from error
    episodes, _, _ = _planned(request)

    def maker(there: Plan[dict[str, Any]], facts: Mapping[str, Any]) -> Timesteps:
        missing = [
            name for several in there.settings["episodes"].values() for name, _ in several if name not in episodes
        ]
        if missing:
            raise UserError(f"{request.folder} has not all episodes of {request.recording}: {missing[0]} is missing.")
        return Timesteps(there.settings, episodes)

    try:
        return repair(request.recording, KIND, maker, workers=request.processes).lines()
    except RecordingError as error:
        raise UserError(str(error)) from error


def _planned(request: Request) -> tuple[dict[str, Path], Checks, Plan[dict[str, Any]]]:
    """The files of all episodes, what they are worth, and what their recording holds."""
    found = find(request.folder)
    root = make_folder(request.root.absolute())
    with _locked(root / ".sketchy.lock"):
        extracted, problems = extract_all(found.archives, root / EXTRACTED, request.workers or cores())
        there = {name: file for name, file in found.episodes.items() if name not in extracted or file.exists()}
        episodes = dict(sorted({**extracted, **there}.items()))
        for remark in [*found.remarks, *problems]:
            console.warn(remark)
        checks = check_all(episodes, root, request.workers or cores())
    _say(checks, problems, request.folder)
    parts = {
        split: [Episode(name, checks.timesteps[name]) for name in names if name in checks.timesteps]
        for split, names in split_by_name(episodes).items()
    }
    _say_empty(parts)
    return episodes, checks, plan(parts, request.image_size, request.windows)


def _locked(path: Path) -> FileLock:
    """A lock that only one preparation below a root can hold."""
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
        lock.release()
    except Timeout:
        console.say(f"Waiting for another process that prepares episodes in {path.parent} (Ctrl-C stops waiting).")
    except OSError as error:
        raise unwritable(path, error) from error
    return lock


def _say(checks: Checks, problems: Sequence[str], folder: Path) -> None:
    """Names what is left out, with counts.

    Raises:
        UserError: nothing is left.
    """
    for name, problem in checks.problems.items():
        console.warn(f"{name} is skipped: {problem}.")
    used, skipped = len(checks.timesteps), len(checks.problems)
    archives = f"; {len(problems)} archives are damaged or refused" if problems else ""
    if not used:
        raise UserError(f"{folder} holds no sound episode ({skipped} are damaged{archives}): download it again.")
    console.say(f"{used} episodes with {sum(checks.timesteps.values())} timesteps, {skipped} skipped{archives}.")


def _say_empty(parts: Mapping[str, Sequence[Episode]]) -> None:
    empty = [split for split in SPLITS if not parts[split]]
    if empty:
        console.warn(
            f"No episode for {' and '.join(empty)}: the first tenth of all episodes, by name, is for val, the next "
            "tenth for test, so that takes ten episodes or more."
        )


def _refuse_other(request: Request, wanted: Plan[dict[str, Any]]) -> None:
    """Says how an existing recording differs, where it does."""
    folder = request.recording
    try:
        if (folder / MANIFEST).exists():
            there = read_manifest(folder, KIND).plan
        else:
            journal = read_journal(folder, KIND) if folder.is_dir() else None
            if journal is None:
                return
            there = journal[0]
    except RecordingError as error:
        raise UserError(str(error)) from error
    if there.difference(wanted) is None:
        return
    was, now = _described(there.settings), _described(wanted.settings)
    what = f"{was} there, {now} here" if was != now else f"as many, but other ones: {was}"
    raise UserError(
        f"{folder} holds other episodes or windows ({what}): choose another --name, or delete it to prepare it again."
    )


def _described(settings: Mapping[str, Any]) -> str:
    counts = ", ".join(f"{len(settings['episodes'][split])} {split}" for split in SPLITS)
    return f"{counts}; windows {', '.join(settings['windows'])}"
