"""A sweep's loop by itself: what is skipped, launched, waited for, and reported."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import pytest
from hydra.core.utils import JobReturn, JobStatus

from apex_lab.base import console
from apex_lab.config import sweeps
from apex_lab.config.sweeps import Item, JobBusy, JobFailed, JobStopped, Sweep


@dataclass
class Known:
    """The state of a job as another process left it."""

    state: str
    reason: str | None = None
    owner: str = "process 7 on elsewhere"


@dataclass
class Launcher:
    """Ends every job as it is told; a list of ends is used up from its front."""

    ends: dict[str, list[object]]
    launched: list[list[str]] = field(default_factory=list)

    def __call__(self, jobs: Sequence[Sequence[str]], first: int) -> list[JobReturn]:
        self.launched.append([job[0] for job in jobs])
        return [self._end(job[0]) for job in jobs]

    def _end(self, name: str) -> JobReturn:
        value = self.ends[name].pop(0)
        returned = JobReturn()
        returned.status = JobStatus.FAILED if isinstance(value, Exception) else JobStatus.COMPLETED
        returned.return_value = value
        return returned


@pytest.fixture(autouse=True)
def _no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweeps, "POLL", 0.0)
    console.setup()


def sweep(states: dict[str, list[Known]], **asked: bool) -> Sweep:
    """A sweep over jobs whose states are read from the front of a list; the last one stays."""

    def known(job: str) -> Known:
        return states[job].pop(0) if len(states[job]) > 1 else states[job][0]

    return Sweep([Item((name,), name, f"job {name}") for name in states], known, **asked)


def test_what_is_done_is_not_launched(capsys: pytest.CaptureFixture[str]) -> None:
    run = sweep({"a": [Known("finished")], "b": [Known("interrupted")], "c": [Known("waiting")], "d": [Known("lost")]})
    launcher = Launcher({"b": ["finished"], "c": ["paused"], "d": [JobFailed("no memory")]})
    run.run(launcher)
    assert launcher.launched == [["b", "c", "d"]]
    assert run.outcomes == {
        0: ("finished", None),
        1: ("finished", None),
        2: ("paused", None),
        3: ("failed", "no memory"),
    }
    run.report()
    said = capsys.readouterr()
    assert said.out.splitlines() == [
        "1 finished before, 3 of 4 jobs to run.",
        "4 jobs: 2 finished, 1 paused, 1 failed.",
        "The same command resumes what has not finished.",
    ]
    assert said.err.splitlines() == ["1 of 4 failed:", "  job d: no memory"]


def test_what_failed_is_tried_again_on_request() -> None:
    states = {"a": [Known("failed", "diverged")], "b": [Known("waiting")]}
    first = sweep(states)
    first.run(Launcher({"b": ["finished"]}))
    assert first.failures == [
        ("job a", "diverged (in an earlier start; hydra.sweeper.retry_failed=true tries it again)")
    ]
    again = sweep(states, retry_failed=True)
    launcher = Launcher({"a": ["finished"], "b": ["finished"]})
    again.run(launcher)
    assert launcher.launched == [["a", "b"]]
    assert again.failures == []


def test_what_another_process_runs_is_waited_for(capsys: pytest.CaptureFixture[str]) -> None:
    states = {
        "a": [Known("waiting"), Known("running"), Known("running"), Known("finished")],
        "b": [Known("waiting"), Known("failed", "diverged")],
        "c": [Known("waiting")],
    }
    run = sweep(states)
    launcher = Launcher({"a": [JobBusy("locked")], "b": [JobBusy("locked")], "c": ["finished"]})
    run.run(launcher)
    assert launcher.launched == [["a", "b", "c"]]
    assert run.outcomes == {0: ("finished", None), 1: ("failed", "diverged"), 2: ("finished", None)}
    assert "waiting for job a, which process 7 on elsewhere is working on" in capsys.readouterr().out


def test_what_another_process_left_is_taken_over() -> None:
    run = sweep({"a": [Known("waiting"), Known("running"), Known("running"), Known("lost")], "b": [Known("finished")]})
    launcher = Launcher({"a": [JobBusy("locked"), "finished"]})
    run.run(launcher)
    assert launcher.launched == [["a"], ["a"]]
    assert run.outcomes == {0: ("finished", None), 1: ("finished", None)}


def test_a_launcher_that_breaks_fails_what_had_not_ended() -> None:
    def broken(jobs: Sequence[Sequence[str]], first: int) -> Sequence[JobReturn]:
        raise MemoryError("a worker was killed")

    run = sweep({"a": [Known("waiting"), Known("finished")], "b": [Known("waiting"), Known("lost")]})
    run.run(broken)
    assert run.outcomes[0] == ("finished", None)
    assert run.failures == [("job b", "the launcher ended with MemoryError: a worker was killed")]


def test_jobs_of_a_broken_launcher_are_launched_once_more(capsys: pytest.CaptureFixture[str]) -> None:
    states = {
        "a": [Known("waiting"), Known("lost")],  # its worker died
        "b": [Known("waiting")],  # had not begun
        "c": [Known("waiting"), Known("interrupted")],  # was stopped
        "d": [Known("waiting"), Known("running"), Known("running"), Known("finished")],  # another sweep's
    }
    launcher = Launcher({"a": ["finished"], "b": ["finished"], "d": [JobBusy("locked")]})
    launched: list[list[str]] = []

    def breaks_once(jobs: Sequence[Sequence[str]], first: int) -> Sequence[JobReturn]:
        launched.append([job[0] for job in jobs])
        if len(launched) == 1:
            raise RuntimeError("a worker is gone")
        return launcher(jobs, first)

    run = sweep(states)
    run.run(breaks_once)
    assert launched[0] == ["a", "b", "c", "d"]
    assert sorted(name for names in launched[1:] for name in names) == ["a", "b"]
    assert {index: state for index, (state, _) in run.outcomes.items()} == {
        0: "finished",
        1: "finished",
        2: "interrupted",
        3: "finished",
    }
    assert (
        "the launcher ended with RuntimeError: a worker is gone; 3 jobs that have not ended" in capsys.readouterr().err
    )


def test_a_launcher_that_cannot_start_is_not_asked_again() -> None:
    launched = 0

    def broken(jobs: Sequence[Sequence[str]], first: int) -> Sequence[JobReturn]:
        nonlocal launched
        launched += 1
        raise RuntimeError("no sbatch here")

    run = sweep({"a": [Known("waiting")], "b": [Known("waiting")]})
    run.run(broken)
    assert launched == 1
    assert [reason for _, reason in run.failures] == ["the launcher ended with RuntimeError: no sbatch here"] * 2


def test_a_job_that_was_stopped_is_no_failure() -> None:
    run = sweep({"a": [Known("waiting")], "b": [Known("waiting")]})
    run.run(Launcher({"a": [JobStopped(15)], "b": ["finished"]}))
    assert run.outcomes == {0: ("interrupted", "stopped by SIGTERM"), 1: ("finished", None)}
    assert (run.failures, run.stopped) == ([], 15)


def test_jobs_that_leave_nothing_behind() -> None:
    run = Sweep([Item(("a",), "a", "job a")])
    run.run(Launcher({"a": [ValueError("bad\nvalue")]}))
    assert run.outcomes[0][0] == "failed"
    assert run.outcomes[0][1] is not None
    assert run.outcomes[0][1].startswith("ValueError: bad")
