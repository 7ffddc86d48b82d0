"""Makes a recording, resumes an interrupted one, or repairs a damaged one."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from recordings.errors import RecordingError
from recordings.files import (
    Arrays,
    allocate,
    allocate_or_leave_nothing,
    check_room,
    no_room,
    sync_folder,
    write_at_once,
)
from recordings.layout import Key
from recordings.manifest import (
    MANIFEST,
    DamagedManifestError,
    Journal,
    Manifest,
    Record,
    read_journal,
    read_manifest,
    write_manifest,
)
from recordings.plan import Facts, Kind, Maker, Plan, S
from recordings.pool import Alone, Pool, Task
from recordings.progress import progress
from recordings.readme import README
from recordings.streams import say
from recordings.verify import Damage, check, mismatches, note_verified, verify
from recordings.worker import Job

LOCK = ".lock"

MakerFor = Callable[[Plan[S], Facts], Maker]
"""Gives the maker of a folder that already exists, from its plan and facts."""


def record(
    root: Path,
    plan: Plan[S],
    maker: Maker,
    *,
    workers: int | None = None,
    shown: bool = True,
    recycle: int | None = None,
) -> Manifest[S]:
    """Makes all items of the plan in `root`; finished items are kept, a finished folder is only checked.

    The bytes depend on the plan and the maker alone: not on the number of workers, the order in which they finish, or
    interruptions. A second process with the same folder waits for the first.

    Args:
        root: the folder; made if it does not exist.
        plan: what it shall hold.
        maker: makes the items, in worker processes.
        workers: number of processes; None: one per core; 0: this process makes all items.
        shown: whether progress is shown on stderr.
        recycle: items after which a worker is replaced, for makers whose memory grows; None: never.

    Raises:
        RecordingError: the folder has other content, the disk is full, an item cannot be made, or workers keep dying.
    """
    root = root.absolute()
    if workers != 0 and type(maker).__module__ == "__main__":
        raise ValueError(f"{type(maker).__name__} stands in the main script: workers can only import it from a module")
    if (root / MANIFEST).exists():
        return check(root, plan.kind, plan)
    _claim(root, plan.kind)
    with _locked(root):
        if (root / MANIFEST).exists():  # another process made it while this one waited
            return check(root, plan.kind, plan)
        return _complete(root, plan, maker, cores() if workers is None else workers, shown, recycle)


def repair(
    root: Path,
    kind: Kind[S],
    maker_for: MakerFor[S],
    *,
    workers: int | None = None,
    shown: bool = True,
    recycle: int | None = None,
) -> Damage:
    """Checks a folder fully and makes its damaged items, and only those, again; returns the damage found.

    An item is written only if its checksum is the recorded one, so intact data are never replaced by other data, and a
    killed repair can be started again. Nothing is written into a folder that is no recording.

    Raises:
        RecordingError: as `record`; also if an item does not have its recorded checksum.
    """
    root = root.absolute()
    try:
        read_manifest(root, kind)
    except DamagedManifestError:
        if not (root / kind.journal).is_file():
            raise RecordingError(
                f"{root / MANIFEST} is damaged and {kind.journal} is missing: delete the folder, if it holds nothing "
                "else, and generate the data again"
            ) from None
    workers = cores() if workers is None else workers
    with _locked(root):
        try:
            manifest = read_manifest(root, kind)
        except DamagedManifestError as error:
            found = read_journal(root, kind)
            if found is None:  # another process has removed it since
                raise
            plan, facts, _ = found
            (root / MANIFEST).unlink()
            _complete(root, plan, maker_for(plan, facts), workers, shown, recycle)
            return Damage([str(error).split(":")[0]], noun=kind.item)
        damage = verify(root, manifest, shown=shown)
        if damage:
            _remake(root, manifest, maker_for, damage.items, workers, shown, recycle)
        return damage


def cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _locked(root: Path) -> Iterator[None]:
    """Locks the folder, with a message if another process holds the lock; turns failed writes into an error."""
    lock = FileLock(root / LOCK)
    try:
        try:
            lock.acquire(timeout=0)
        except Timeout:
            say(f"waiting for another process that works on {root} (Ctrl-C stops waiting)", error=True)
            lock.acquire(poll_interval=0.2)
        try:
            yield
        finally:
            lock.release()
    except OSError as error:
        raise no_room(error, error.filename or root) from error


def _claim(root: Path, kind: Kind[S]) -> None:
    """Creates the folder; refuses one with other content."""
    try:
        root.mkdir(parents=True, exist_ok=True)
        strange = [path.name for path in root.iterdir() if not path.name.startswith(".")]
    except OSError as error:
        raise RecordingError(f"{root} cannot be used as a folder ({error.strerror}): choose another") from None
    if strange and not (root / kind.journal).exists():
        raise RecordingError(
            f"{root} contains files that are not {kind.name} ({sorted(strange)[0]}): choose an empty folder"
        )


def _complete(root: Path, plan: Plan[S], maker: Maker, workers: int, shown: bool, recycle: int | None) -> Manifest[S]:
    """Makes missing and damaged items and finishes the folder. Needs the lock and no manifest."""
    layout, name = plan.layout, plan.kind.name
    facts: Facts | None = None
    records: dict[Key, Record] = {}
    found = read_journal(root, plan.kind)
    if found is not None:
        there, facts, records = found
        if what := there.difference(plan):
            raise RecordingError(
                f"{root} was started with other settings ({what}): choose another folder or delete this one"
            )
        allocate(root, layout, name)
        for key in mismatches(root, plan, records, shown=shown):
            del records[key]
    check_room(root, layout, name)
    missing = [key for key in layout.all_keys() if key not in records]
    if missing or facts is None:
        with _pool(_job(root, plan, maker), workers, recycle) as pool:
            facts = _agreed(root, facts, pool.start())
            with closing(Journal(root, plan, facts, records)) as journal:
                if not records:
                    allocate_or_leave_nothing(root, layout, name)
                for key, record in _made(root, plan, pool, [Task(key) for key in missing], shown):
                    journal.append(key, record)
                    records[key] = record
    manifest = Manifest(plan, facts, records, plan.fingerprint)
    _sync(root, manifest, missing)
    Journal(root, plan, facts, records).close()  # in storage order, so that equal data have equal journals
    write_at_once(root / README, plan.kind.readme(manifest))
    write_manifest(root, manifest)
    note_verified(root, manifest)
    return manifest


def _remake(
    root: Path,
    manifest: Manifest[S],
    maker_for: MakerFor[S],
    bad: list[Key],
    workers: int,
    shown: bool,
    recycle: int | None,
) -> None:
    """Repairs headers, sizes and journal of a finished folder and makes the given items again."""
    plan = manifest.plan
    allocate(root, plan.layout, plan.kind.name)
    if bad:
        with _pool(_job(root, plan, maker_for(plan, manifest.facts)), workers, recycle) as pool:
            tasks = [Task(key, manifest.records[key].checksum) for key in bad]
            for _ in _made(root, plan, pool, tasks, shown):
                pass
    _sync(root, manifest, bad)
    Journal(root, plan, manifest.facts, manifest.records).close()
    note_verified(root, manifest)


def _job(root: Path, plan: Plan[S], maker: Maker) -> Job:
    return Job(root, plan.layout, plan.kind.item, plan.kind.notes, maker)


def _pool(job: Job, workers: int, recycle: int | None) -> Pool | Alone:
    return Pool(job, workers, recycle) if workers else Alone(job)


def _made(
    root: Path, plan: Plan[S], pool: Pool | Alone, tasks: list[Task], shown: bool
) -> Iterator[tuple[Key, Record]]:
    title = f"{plan.kind.name} {root.name}"
    with progress(title, len(tasks), plan.kind.items, shown=shown and bool(tasks)) as advance:
        for key, record in pool.run(tasks):
            yield key, record
            advance(1)


def _agreed(root: Path, begun: Facts | None, here: Facts) -> Facts:
    """The facts of the maker here; refuses to resume a folder that was started with other versions."""
    for name, version in (begun or here)["versions"].items():
        other = here["versions"].get(name)
        if other != version:
            raise RecordingError(
                f"{root} was started with {name} {version} and here is {name} {other}: install that version, or delete "
                "the folder and generate the data again"
            )
    return here


def _sync(root: Path, manifest: Manifest[S], made: list[Key]) -> None:
    """Syncs all arrays to the disk and verifies the given items."""
    kind, layout = manifest.plan.kind, manifest.layout
    for split in layout.splits:
        with closing(Arrays(root, split, layout, writable=True)) as arrays:
            arrays.sync()
        sync_folder(root / split)
    bad = mismatches(root, manifest.plan, {key: manifest.records[key] for key in made}, shown=False)
    if bad:
        raise RecordingError(
            f"{root} reads back other bytes than were written ({kind.item} {bad[0][0]}/{bad[0][1]} and {len(bad) - 1} "
            "more): check that disk and run the same command again"
        )
