"""Runs the jobs of a sweep: skips what is done, leaves to others what they are doing, and collects every outcome.

Hydra's launcher does the jobs, in this process or elsewhere; what became of each comes back through Hydra's job
returns, so it is right under every launcher. `hydra_plugins.apex_lab.sweeper` connects this to Hydra.
"""

from __future__ import annotations

import signal
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Any, Protocol

from hydra.core.utils import JobReturn, JobStatus

from apex_lab.base import console
from apex_lab.base.validation import one_line

Launch = Callable[[Sequence[Sequence[str]], int], Sequence[JobReturn]]
"""(words of each job, number of the first) -> what became of each."""

Relaying = Callable[[], AbstractContextManager[None]]

POLL = 2.0
"""Seconds between two looks at runs that other processes work on."""


class Known(Protocol):
    """What is known of a job without starting it; `apex_lab.runs.state.RunState` is one."""

    @property
    def state(self) -> str: ...
    @property
    def reason(self) -> str | None: ...
    @property
    def owner(self) -> str: ...


class JobFailed(RuntimeError):
    """A job failed; the sentence."""


class JobBusy(RuntimeError):
    """Another process is working on the job; the sentence."""


class JobStopped(RuntimeError):
    """A job was asked to stop and has stored what it did; the number of the signal."""

    @property
    def signum(self) -> int:
        return int(self.args[0])

    def __str__(self) -> str:
        return f"stopped by {signal.Signals(self.signum).name}"


@dataclass(frozen=True)
class Item:
    """One job of a sweep.

    Attributes:
        words: its overrides.
        job: as the entry point's check made it.
        title: in a few words.
    """

    words: tuple[str, ...]
    job: Any
    title: str


@dataclass
class Sweep:
    """One start of a sweep.

    Attributes:
        items: its jobs.
        known: tells the state of a job; None where jobs leave nothing behind that could be looked at.
        retry_failed: run jobs again that failed in an earlier start.
        outcomes: index of the job -> (state, reason), filled by `run`.
        stopped: the signal by which a job was stopped, when the sweep itself was not.
    """

    items: Sequence[Item]
    known: Callable[[Any], Known] | None = None
    retry_failed: bool = False
    outcomes: dict[int, tuple[str, str | None]] = field(default_factory=dict)
    stopped: int | None = None
    _relaying: Relaying = nullcontext
    _again: set[int] = field(default_factory=set)

    def run(self, launch: Launch, relaying: Relaying = nullcontext) -> None:
        """Runs what there is to run until every job has an outcome.

        Args:
            launch: does jobs.
            relaying: a block in which a request to stop goes to the jobs, where other processes do them.

        Raises:
            Interrupted: the sweep was asked to stop.
        """
        self._relaying = relaying
        waiting = [index for index in range(len(self.items)) if not self._settled(index, first=True)]
        if before := Counter(state for state, _ in self.outcomes.values()):
            console.say(f"{_counted(before)} before, {len(waiting)} of {len(self.items)} jobs to run.")
        while waiting:
            self._launch(waiting, launch)
            waiting = self._free([index for index in range(len(self.items)) if index not in self.outcomes])

    @property
    def failures(self) -> list[tuple[str, str]]:
        """(title, reason) of every job that failed."""
        return [
            (self.items[index].title, reason or "no reason was recorded")
            for index, (state, reason) in sorted(self.outcomes.items())
            if state == "failed"
        ]

    def report(self, resumes: bool = True) -> None:
        """Says what became of the jobs; failures go to standard error.

        Args:
            resumes: whether the same command goes on with what was stopped.
        """
        counts = Counter(state for state, _ in self.outcomes.values())
        if len(self.items) > 1 and set(counts) != {"failed"}:
            console.say(f"{len(self.items)} jobs: {_counted(counts)}.")
        if resumes and (counts["paused"] or counts["interrupted"]):
            console.say("The same command resumes what has not finished.")
        if self.failures:
            console.error(f"{len(self.failures)} of {len(self.items)} failed:")
            for title, reason in self.failures:
                console.error(f"  {title}: {reason}")

    def _settled(self, index: int, first: bool = False) -> bool:
        """Takes over the outcome of a job that needs no work of this process.

        Args:
            index: of the job.
            first: at the start of the sweep, where what failed in an earlier start may be asked for again.
        """
        if self.known is None:
            return False
        known = self.known(self.items[index].job)
        if known.state == "finished":
            self.outcomes[index] = ("finished", None)
        elif known.state == "failed" and not (first and self.retry_failed):
            hint = " (in an earlier start; hydra.sweeper.retry_failed=true tries it again)" if first else ""
            self.outcomes[index] = ("failed", f"{known.reason or 'no reason was recorded'}{hint}")
        return index in self.outcomes

    def _launch(self, indices: Sequence[int], launch: Launch) -> None:
        with self._relaying():
            try:
                returns = launch([self.items[index].words for index in indices], indices[0])
            except Exception as error:  # noqa: BLE001 - a launcher may raise anything when a worker dies
                self._broke(indices, f"the launcher ended with {type(error).__name__}: {one_line(error)}")
                return
            for index, returned in zip(indices, returns, strict=True):
                self._take(index, returned)

    def _take(self, index: int, returned: JobReturn) -> None:
        """Takes over what a job's return says; a job that another process is working on stays without an outcome."""
        if returned.status == JobStatus.COMPLETED:
            value = returned.return_value
            self.outcomes[index] = (value if isinstance(value, str) else "finished", None)
            return
        error = returned._return_value  # the property raises it, and prints
        if isinstance(error, JobBusy):
            return
        if isinstance(error, JobStopped):
            self.stopped = self.stopped or error.signum
            self.outcomes[index] = ("interrupted", str(error))
            return
        known = isinstance(error, JobFailed)
        self.outcomes[index] = ("failed", str(error) if known else f"{type(error).__name__}: {one_line(error)}")

    def _broke(self, indices: Sequence[int], reason: str) -> None:
        """Settles jobs whose launcher broke. Those that had not ended are launched once more, if any had begun: a
        launcher such as joblib ends all workers when one dies.
        """
        states = {
            index: self.known(self.items[index].job).state if self.known else "waiting"
            for index in indices
            if not self._settled(index)
        }
        begun = any(state != "waiting" for state in states.values())
        for index, state in states.items():
            if state in ("interrupted", "paused"):
                self.outcomes[index] = (state, None)
            elif state == "running":
                pass  # its worker lives, or another sweep has it: it is waited for
            elif begun and index not in self._again:
                self._again.add(index)
            else:
                self.outcomes[index] = ("failed", reason)
        if again := [index for index in states if index not in self.outcomes]:
            console.warn(f"{reason}; {len(again)} jobs that have not ended are looked at once more.")

    def take_stock(self) -> None:
        """Fills in what became of the jobs of a sweep that was stopped."""
        for index in range(len(self.items)):
            if index not in self.outcomes and not self._settled(index) and self.known is not None:
                self.outcomes[index] = (self.known(self.items[index].job).state, None)

    def _free(self, busy: Sequence[int]) -> list[int]:
        """Waits until some of the jobs that others work on are free; those of them that are left to run."""
        told: set[int] = set()
        while busy := [index for index in busy if not self._settled(index)]:
            assert self.known is not None
            time.sleep(POLL)  # at first too: the other may have taken the run, and not yet written that it has
            known = {index: self.known(self.items[index].job) for index in busy}
            free = [index for index in busy if known[index].state != "running"]
            if free:
                return free
            for index in busy:
                if index not in told:
                    console.say(f"waiting for {self.items[index].title}, which {known[index].owner} is working on")
                    told.add(index)
        return []


def _counted(counts: Counter[str]) -> str:
    return ", ".join(f"{number} {state}" for state, number in counts.most_common())
