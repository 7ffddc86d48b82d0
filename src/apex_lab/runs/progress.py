"""How far runs are, and how long they have taken and will take, in numbers. Imports no PyTorch."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml

from apex_lab.runs.identity import seed_folders, stored_configuration
from apex_lab.runs.listed import Listed
from apex_lab.runs.state import RunState, State, read_state

OPEN: tuple[State, ...] = ("waiting", "running", "lost", "paused", "interrupted")
"""States in which the same command goes on."""


@dataclass(frozen=True)
class Progress:
    """One job as it stands.

    Attributes:
        name: of its configuration.
        seed: its seed.
        words: its overrides; of a run found in a folder, those that it was started with.
        state: of its run.
        steps: weight updates done, as far as is known.
        max_steps: of all of them; None where it is not known.
        seconds: of training so far, over all restarts.
        left: seconds of training still to go; None where it is not known.
    """

    name: str
    seed: int
    words: tuple[str, ...]
    state: RunState
    steps: int
    max_steps: int | None
    seconds: float
    left: float | None = None

    def as_json(self) -> dict[str, Any]:
        """Plain values: what `status --json` prints of a job."""
        return {
            "name": self.name,
            "seed": self.seed,
            "words": list(self.words),
            "folder": str(self.state.folder),
            "state": self.state.state,
            "reason": self.state.reason,
            "steps": self.steps,
            "max_steps": self.max_steps,
            "seconds_spent": round(self.seconds, 1),
            "seconds_to_go": None if self.left is None else round(self.left, 1),
        }


@dataclass(frozen=True)
class Overview:
    """All jobs together.

    Attributes:
        jobs: in their order.
    """

    jobs: tuple[Progress, ...]

    @property
    def counts(self) -> Counter[str]:
        """State -> number of jobs."""
        return Counter(job.state.state for job in self.jobs)

    @property
    def spent(self) -> float:
        """Seconds of training so far."""
        return sum(job.seconds for job in self.jobs)

    @property
    def left(self) -> float:
        """Seconds of training to go, of those jobs of which it is known."""
        return sum(job.left or 0.0 for job in self.jobs)

    @property
    def unknown(self) -> int:
        """Jobs still to do of which nothing tells how long they take."""
        return sum(job.left is None for job in self.jobs)

    @property
    def ended(self) -> bool:
        """Whether nothing is left that the same command would go on with."""
        return not any(job.state.state in OPEN for job in self.jobs)

    def as_json(self) -> dict[str, Any]:
        """Plain values: what `status --json` prints."""
        return {
            "counts": dict(self.counts),
            "seconds_spent": round(self.spent, 1),
            "seconds_to_go": round(self.left, 1),
            "jobs_of_unknown_length": self.unknown,
            "jobs": [job.as_json() for job in self.jobs],
        }


def overview(jobs: Iterable[Listed]) -> Overview:
    """The jobs of a command line as they stand."""
    return _estimated([_of_listed(job) for job in jobs])


def found(outputs: Path, before: Overview | None = None) -> Overview:
    """Every run in a folder as it stands.

    Args:
        outputs: `paths.outputs`.
        before: what was found earlier; finished runs are not read again.

    Raises:
        UserError: the folder cannot be listed.
    """
    known = {job.state.folder: job for job in before.jobs if job.state.state == "finished"} if before else {}
    return _estimated([known.get(folder) or _of_folder(folder) for folder in seed_folders(outputs)])


def _of_listed(job: Listed) -> Progress:
    trained = job.raw.get("optimizer") is not None
    steps = job.raw["trainer"]["max_steps"] if trained else 0
    return _measured(Progress(job.name, job.seed, job.words, job.state, 0, steps, 0.0))


def _of_folder(folder: Path) -> Progress:
    state, seed = read_state(folder), int(folder.name.removeprefix("seed_"))
    words = state.record.get("overrides")
    words = tuple(str(word) for word in words) if isinstance(words, list) else ()
    return _measured(Progress(folder.parent.name, seed, words, state, 0, _max_steps(state), 0.0))


def _max_steps(state: RunState) -> int | None:
    """From the record; records of earlier versions have it in config.yaml beside them."""
    steps = state.record.get("max_steps")
    if isinstance(steps, int):
        return steps
    if state.state == "finished":
        return state.steps
    try:
        steps = stored_configuration(state.folder)["trainer"]["max_steps"]
    except (OSError, ValueError, yaml.YAMLError, LookupError, TypeError, RecursionError):
        return None
    return steps if isinstance(steps, int) else None


def _measured(job: Progress) -> Progress:
    """Steps, seconds and, where its own speed tells, seconds to go.

    The record is written with each checkpoint; a running process has got further, as the last row of its curves shows.
    """
    state = job.state
    job = replace(job, steps=state.steps, seconds=state.seconds)
    if state.state in ("finished", "failed", "damaged"):
        return replace(job, left=0.0)
    waited = 0.0
    if state.state == "running":
        row = _last_row(state.folder / "curves.csv")
        if row is not None and row[0] > state.steps:
            begun = _when(state.record) if state.steps else _started(state.record)
            job = replace(job, steps=row[0], seconds=state.seconds + max(0.0, row[1] - begun))
            waited = max(0.0, time.time() - row[1])
        elif (beat := _when(state.record)) > 0 and state.steps:
            waited = max(0.0, time.time() - beat)
    if job.max_steps is not None and job.steps > 0 and job.seconds > 0:
        left = (job.max_steps - job.steps) * job.seconds / job.steps
        return replace(job, left=max(0.0, left - waited))
    return job


def _last_row(curves: Path) -> tuple[int, float] | None:
    """Step of the last whole row of a run's curves, and when it was written; None where there is none."""
    try:
        with open(curves, "rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - 16_384))
            rows = file.read().rpartition(b"\n")[0].splitlines()[1:]  # neither the header nor half a row
            when = os.fstat(file.fileno()).st_mtime
    except OSError:
        return None
    step = rows[-1].partition(b",")[0] if rows else b""
    return (int(step), when) if step.isdigit() and len(step) < 19 else None


def _when(record: Mapping[str, Any]) -> float:
    return _seconds_since_epoch(record.get("heartbeat"))


def _started(record: Mapping[str, Any]) -> float:
    history = record.get("history")
    last = history[-1].get("started") if isinstance(history, list) and history else None
    return _seconds_since_epoch(last or record.get("started"))


def _seconds_since_epoch(text: object) -> float:
    """A time of a record; now where it has none."""
    try:
        return datetime.fromisoformat(str(text)).timestamp()
    except (ValueError, OverflowError, OSError):  # of a year that no clock has
        return time.time()


def _estimated(jobs: Sequence[Progress]) -> Overview:
    """Gives jobs without a speed of their own the mean of the same configuration's other runs."""
    whole: dict[str, list[float]] = {}
    for job in jobs:
        if job.steps > 0 and job.seconds > 0 and job.max_steps:
            whole.setdefault(job.name, []).append(job.seconds * job.max_steps / job.steps)
    return Overview(tuple(_with_mean(job, whole.get(job.name)) for job in jobs))


def _with_mean(job: Progress, whole: Sequence[float] | None) -> Progress:
    if job.left is None and job.max_steps == 0:  # nothing is trained
        return replace(job, left=0.0)
    if job.left is not None or not whole:
        return job
    return replace(job, left=max(0.0, sum(whole) / len(whole) - job.seconds))
