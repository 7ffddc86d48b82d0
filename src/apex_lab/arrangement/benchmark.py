"""All scenarios of one setting: what was done before, what is left, and the summary in the end."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from apex_lab.arrangement.pool import Pool
from apex_lab.arrangement.results import Outcome, Store, identity, summary, table, write
from apex_lab.arrangement.task import Failure, Setting, Task
from apex_lab.base import console, faults
from apex_lab.base.errors import Busy, UserError
from apex_lab.base.files import make_folder, unwritable
from apex_lab.base.progress import Meter
from apex_lab.base.validation import one_line, sentence
from apex_lab.runs import provenance
from recordings import cores

MAX_FAILURES = 5
"""Scenarios without an outcome after which no further one is started."""


@dataclass(frozen=True)
class Benchmark:
    """One setting and what is asked of it.

    Attributes:
        setting: perception, world and seed.
        title: of the perception, for people.
        tasks: numbers of objects.
        scenarios: of each task.
        videos: scenarios to film; where there are any, no others are run.
        workers: processes; None: one per core.
        again: whether what was done before is done once more.
        base: folder below which `arrangement/<identity>/` lies.
        into: a further folder for the summary, such as that of the run whose row in table 4 it makes; None: nowhere.
    """

    setting: Setting
    title: str
    tasks: tuple[int, ...]
    scenarios: int
    videos: tuple[Task, ...]
    workers: int | None
    again: bool
    base: Path
    into: Path | None


def run(asked: Benchmark) -> None:
    """Runs what is left, stores every outcome when it is there, then the summary; prints table and paths.

    Raises:
        UserError: perception cannot do this task, scenarios have failed, or the disk is full. What is stored stays.
        Busy: another process works on the same.
        Interrupted: this process was asked to stop; what is stored stays.
    """
    key = identity(asked.setting)
    folder = asked.base / "arrangement" / key[:8]
    with _locked(folder):
        store = Store(folder, key)
        if asked.videos:
            _film(asked, store)
        else:
            _score(asked, store)


def _score(asked: Benchmark, store: Store) -> None:
    every = [Task(objects, index) for objects in asked.tasks for index in range(asked.scenarios)]
    found: dict[Task, Outcome] = {}
    for task in every if not asked.again else ():
        if (before := store.read(task)) is not None:
            found[task] = before
    left = [task for task in every if task not in found]
    for task, outcome in _outcomes(asked, left, len(found)):
        store.write(task, outcome)
        found[task] = outcome
    commit, dirty = provenance.commit()
    setting = asked.setting
    about = {
        "perception": {"name": asked.title, "checkpoint_sha256": setting.digest, **setting.perception},
        "seed": setting.seed,
        "world": setting.world.model_dump(mode="json"),
        "identity": store.key,
        "made_by": {"versions": provenance.versions(), "commit": commit, "dirty": dirty, "device": setting.device},
    }
    content = {**summary({n: [found[t] for t in every if t.objects == n] for n in asked.tasks}), **about}
    paths = write(store.folder, asked.title, content)
    if asked.into is not None:
        paths = write(asked.into, asked.title, content)
    console.say(table(asked.title, content).rstrip("\n"))
    for path in paths:
        console.say(str(path))


def _film(asked: Benchmark, store: Store) -> None:
    make_folder(store.videos)
    every = [Task(task.objects, task.index, store.film(task)) for task in asked.videos]
    left = [task for task in every if asked.again or not store.film(task).exists()]
    for task, outcome in _outcomes(asked, left, len(every) - len(left)):
        store.write(task, outcome)
    for task in every:
        known = store.read(task)
        for one in known["objects"] if known is not None else ():
            console.say(
                f"{task.name}: {one['name']} {one['distance_m']:.3f} m from its goal, {one['reason'] or 'home'}"
            )
        console.say(str(store.film(task)))


def _outcomes(asked: Benchmark, left: Sequence[Task], done: int) -> Iterator[tuple[Task, Outcome]]:
    """The outcomes of scenarios in the order in which they finish.

    Raises:
        UserError: some have none, after all others are done; or none can have one.
    """
    failed: dict[Task, str] = {}
    pool = Pool(asked.setting, asked.workers or cores())
    with Meter("scenario", done + len(left), done) as meter, closing(pool.run(left)) as answers:
        for task, answer in answers:
            if not isinstance(answer, Failure):
                yield task, answer
                done += 1
                meter.show(done)
                continue
            if answer.final:
                raise UserError(answer.reason)
            failed[task] = f"{answer.reason} ({faults.stored(answer.details)})" if answer.details else answer.reason
            if len(failed) == MAX_FAILURES:
                break
    if failed:
        first = next(iter(failed))
        raise UserError(
            sentence(
                f"{len(failed)} scenarios have no outcome (the first, {first.name}: {one_line(failed[first])}); the "
                "same command tries them again"
            )
        )


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    lock = FileLock(str(make_folder(folder) / ".lock"))
    try:
        lock.acquire(blocking=False)
    except Timeout as error:
        raise Busy(f"{folder} is being worked on by another process: wait for it or stop it.") from error
    except OSError as error:
        raise unwritable(folder, error) from error
    try:
        yield
    finally:
        lock.release()
