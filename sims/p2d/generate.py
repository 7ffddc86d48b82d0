"""Generates a P2D folder, resumes an interrupted generation, or repairs a damaged folder."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from sims.errors import SimError
from sims.p2d.manifest import (
    JOURNAL,
    MANIFEST,
    DamagedManifestError,
    Facts,
    Journal,
    Manifest,
    Record,
    difference,
    fingerprint,
    read_journal,
    read_manifest,
    sync_folder,
    write_at_once,
    write_manifest,
)
from sims.p2d.pool import RECYCLE, Pool, Task
from sims.p2d.progress import progress
from sims.p2d.readme import README, readme
from sims.p2d.settings import Settings
from sims.p2d.store import FIELDS, SPLITS, Arrays, Key, allocate, array_path, check_room, keys, no_room
from sims.p2d.verify import Damage, check, mismatches, note_verified, verify

SIMULATOR = "sims.p2d.simulator"
"""Module with `simulate(settings, split, index) -> Trajectory` and `facts(settings) -> Facts`."""

LOCK = ".lock"


def generate(
    root: Path,
    settings: Settings,
    *,
    workers: int | None = None,
    shown: bool = True,
    simulator: str = SIMULATOR,
    recycle: int = RECYCLE,
) -> Manifest:
    """Generates the data set with these settings in `root`; finished trajectories are kept.

    The bytes depend on the settings and the versions of the simulator alone: not on the number of workers, the order
    in which they finish, or interruptions. A second process with the same folder waits for the first.

    Args:
        root: the folder; made if it does not exist.
        settings: settings of the data set.
        workers: number of processes; None: one per core.
        shown: whether progress is shown on stderr.
        simulator: module that simulates (tests bring their own).
        recycle: trajectories after which a worker is replaced.

    Raises:
        SimError: the folder has other content, the disk is full, the simulator is missing or its workers keep dying.
    """
    root = root.absolute()
    if (root / MANIFEST).exists():
        return check(root, settings)
    _claim(root)
    with _locked(root):
        if (root / MANIFEST).exists():  # another process made it while this one waited
            return check(root, settings)
        return _complete(root, settings, workers or cores(), shown, simulator, recycle)


def repair(
    root: Path,
    *,
    workers: int | None = None,
    shown: bool = True,
    simulator: str = SIMULATOR,
) -> Damage:
    """Checks a folder fully and generates its damaged trajectories, and only those, again; returns the damage found.

    A trajectory is written only if its checksum is the recorded one, so intact data are never replaced by other data,
    and a killed repair can be started again.

    Raises:
        SimError: as `generate`; also if a trajectory does not have its recorded checksum.
    """
    root = root.absolute()
    if not root.is_dir():
        read_manifest(root)
    with _locked(root):
        try:
            manifest = read_manifest(root)
        except DamagedManifestError as error:
            found = read_journal(root)
            if found is None:
                raise SimError(
                    f"{root / MANIFEST} is damaged and {JOURNAL} is missing: delete the folder and generate the data "
                    "again"
                ) from None
            (root / MANIFEST).unlink()
            _complete(root, found[0], workers or cores(), shown, simulator, RECYCLE)
            return Damage([str(error).split(":")[0]])
        damage = verify(root, manifest, shown=shown)
        if damage:
            _remake(root, manifest, damage.trajectories, workers or cores(), shown, simulator)
        return damage


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _locked(root: Path) -> Iterator[None]:
    """Locks the folder, with a message if another process holds the lock; turns failed writes into `SimError`."""
    lock = FileLock(root / LOCK)
    try:
        try:
            lock.acquire(timeout=0)
        except Timeout:
            print(f"waiting for another process that works on {root} (Ctrl-C stops waiting)", file=sys.stderr)
            lock.acquire(poll_interval=0.2)
        try:
            yield
        finally:
            lock.release()
    except OSError as error:
        raise no_room(error, error.filename or root) from error


def _claim(root: Path) -> None:
    """Creates the folder; refuses one with other content."""
    try:
        root.mkdir(parents=True, exist_ok=True)
        strange = [path.name for path in root.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        raise SimError(f"{root} cannot be used as a folder ({error.strerror}): choose another") from None
    if strange and not (root / JOURNAL).exists():
        raise SimError(f"{root} contains files that are not P2D ({sorted(strange)[0]}): choose an empty folder")


def _complete(root: Path, settings: Settings, workers: int, shown: bool, simulator: str, recycle: int) -> Manifest:
    """Generates missing and damaged trajectories and finishes the folder. Needs the lock and no manifest."""
    facts: Facts | None = None
    records: dict[Key, Record] = {}
    found = read_journal(root)
    if found is not None:
        there, facts, records = found
        if what := difference(there, settings):
            raise SimError(f"{root} was started with other settings ({what}): choose another folder or delete this one")
        allocate(root, settings)
        for key in mismatches(root, settings, records, shown=shown):
            del records[key]
    check_room(root, settings)
    missing = [key for key in keys(settings) if key not in records]
    if missing or facts is None:
        with Pool(root, settings, simulator, workers, recycle) as pool:
            facts = _agreed(root, facts, pool.start())
            with closing(Journal(root, settings, facts, records)) as journal:
                if not records:
                    _allocate_or_leave_nothing(root, settings)
                for key, record in _made(root, settings, pool, [Task(key) for key in missing], shown):
                    journal.append(key, record)
                    records[key] = record
    manifest = Manifest(settings, facts, records, fingerprint(settings))
    _sync(root, manifest, missing)
    Journal(root, settings, facts, records).close()  # in storage order, so that equal data have equal journals
    write_at_once(root / README, readme(manifest))
    write_manifest(root, manifest)
    note_verified(root, manifest)
    return manifest


def _remake(root: Path, manifest: Manifest, bad: list[Key], workers: int, shown: bool, simulator: str) -> None:
    """Repairs the headers and sizes of a finished folder's files and generates the given trajectories again."""
    settings = manifest.settings
    allocate(root, settings)
    if bad:
        with Pool(root, settings, simulator, workers) as pool:
            tasks = [Task(key, manifest.records[key].checksum) for key in bad]
            for _ in _made(root, settings, pool, tasks, shown):
                pass
    _sync(root, manifest, bad)
    note_verified(root, manifest)


def _made(root: Path, settings: Settings, pool: Pool, tasks: list[Task], shown: bool) -> Iterator[tuple[Key, Record]]:
    total = len(tasks) * settings.frames
    with progress(f"P2D {root.name}", total, "frames", shown=shown and total > 0) as advance:
        for key, record in pool.run(tasks):
            yield key, record
            advance(settings.frames)


def _agreed(root: Path, begun: Facts | None, here: Facts) -> Facts:
    """The facts of the simulator here; refuses to resume a folder that was started with other versions."""
    for name, version in (begun or here)["versions"].items():
        other = here["versions"].get(name)
        if other != version:
            raise SimError(
                f"{root} was started with {name} {version} and here is {name} {other}: install that version, or delete "
                "the folder and generate the data again"
            )
    return here


def _allocate_or_leave_nothing(root: Path, settings: Settings) -> None:
    try:
        allocate(root, settings)
    except SimError:
        for split in SPLITS:  # empty arrays would only take up space on a full disk
            for name in FIELDS:
                array_path(root, split, name).unlink(missing_ok=True)
            with suppress(OSError):  # not there, or somebody put a file there
                (root / split).rmdir()
        raise


def _sync(root: Path, manifest: Manifest, made: list[Key]) -> None:
    """Syncs all arrays to the disk and verifies the given trajectories."""
    for split in SPLITS:
        with closing(Arrays(root, split, manifest.settings, writable=True)) as arrays:
            arrays.sync()
        sync_folder(root / split)
    bad = mismatches(root, manifest.settings, {key: manifest.records[key] for key in made}, shown=False)
    if bad:
        raise SimError(
            f"{root} reads back other bytes than were written (trajectory {bad[0][0]}/{bad[0][1]} and {len(bad) - 1} "
            "more): check that disk and run the same command again"
        )
