"""Runs the jobs of a sweep: skips what is done, leaves to others what they are doing, and collects every outcome.

Hydra's launcher does the jobs, in this process or elsewhere; what became of each comes back through Hydra's job
returns, so it is right under every launcher. `hydra_plugins.apex_lab.sweeper` connects this to Hydra.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from hydra.core.utils import JobReturn, JobStatus

from apex_lab.base import console
from apex_lab.base.validation import one_line

Launch = Callable[[Sequence[Sequence[str]], int], Sequence[JobReturn]]
"""(words of each job, number of the first) -> what became of each."""

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
    """

    items: Sequence[Item]
    known: Callable[[Any], Known] | None = None
    retry_failed: bool = False
    outcomes: dict[int, tuple[str, str | None]] = field(default_factory=dict)

    def run(self, launch: Launch) -> None:
        """Runs what there is to run until every job has an outcome."""
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

    def report(self) -> None:
        """Says what became of the jobs; failures go to standard error."""
        counts = Counter(state for state, _ in self.outcomes.values())
        if len(self.items) > 1 and set(counts) != {"failed"}:
            console.say(f"{len(self.items)} jobs: {_counted(counts)}.")
        if counts["paused"] or counts["interrupted"]:
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
        try:
            returns = launch([self.items[index].words for index in indices], indices[0])
        except Exception as error:  # noqa: BLE001 - a launcher may raise anything when a job's process dies
            for index in indices:
                self._died(index, f"the launcher ended with {type(error).__name__}: {one_line(error)}")
            return
        for index, returned in zip(indices, returns, strict=True):
            outcome = _outcome(returned)
            if outcome is not None:
                self.outcomes[index] = outcome

    def _died(self, index: int, reason: str) -> None:
        """Settles a job whose launcher broke: it may have ended before."""
        if not self._settled(index):
            self.outcomes[index] = ("failed", reason)

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


def _outcome(returned: JobReturn) -> tuple[str, str | None] | None:
    """What a job's return says; None: another process is working on it."""
    if returned.status == JobStatus.COMPLETED:
        value = returned.return_value
        return (value if isinstance(value, str) else "finished"), None
    error = returned._return_value  # the property raises it, and prints
    if isinstance(error, JobBusy):
        return None
    return "failed", str(error) if isinstance(error, JobFailed) else f"{type(error).__name__}: {one_line(error)}"


def _counted(counts: Counter[str]) -> str:
    return ", ".join(f"{number} {state}" for state, number in counts.most_common())
