"""`python -m apex_lab.status`: states, steps, time left, hours, JSON, and a table that fits a narrow terminal."""

from __future__ import annotations

import functools
import io
import json
import os
import socket
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from apex_lab import status
from apex_lab.base.files import write_json
from apex_lab.runs.listed import Listed, listed
from apex_lab.runs.progress import Progress, overview
from apex_lab.runs.state import read_state
from tests.conftest import TINY, Ended

WORDS = (*(word for word in TINY[2:]), "trainer.max_steps=100", "seed=0,1,2,3,4,5")
CONF = TINY[1]


@functools.cache
def composed() -> tuple[Listed, ...]:
    """The jobs of `WORDS`; their folders are relative, so each test has its own."""
    return tuple(listed(WORDS, CONF))


def when(seconds_ago: float) -> str:
    return datetime.fromtimestamp(time.time() - seconds_ago, UTC).isoformat()


def record(folder: Path, status: str, steps: int, seconds: float, **more: Any) -> None:
    """A run's record as `Run` writes it; its process is this one."""
    folder.mkdir(parents=True)
    about = {"status": status, "steps": steps, "seconds": seconds, "host": socket.gethostname(), "pid": os.getpid()}
    write_json(folder / "run.json", {**about, "heartbeat": when(0), "started": when(0), **more})
    (folder / ".lock").touch()
    if status == "finished":
        write_json(folder / "metrics.json", {})


@pytest.fixture
def jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Listed]:
    """Six seeds of one configuration: finished, running, lost, failed, paused, waiting."""
    monkeypatch.chdir(tmp_path)
    jobs = composed()
    record(jobs[0].folder, "finished", 100, 1000.0)
    record(jobs[1].folder, "running", 40, 200.0, heartbeat=when(30))
    record(jobs[2].folder, "running", 10, 100.0, pid=2**22 + 1)
    record(jobs[3].folder, "failed", 5, 50.0, outcome="failed", reason="No space left.")
    record(jobs[4].folder, "paused", 50, 450.0, outcome="paused", reason="Time is up.")
    return [job.again() for job in jobs]


def by_state(jobs: list[Listed]) -> dict[str, Progress]:
    return {job.state.state: job for job in overview(jobs).jobs}


def test_every_state_has_its_steps_and_its_time_left(jobs: list[Listed]) -> None:
    found = by_state(jobs)
    assert list(found) == ["finished", "running", "lost", "failed", "paused", "waiting"]
    assert (found["finished"].steps, found["finished"].seconds, found["finished"].left) == (100, 1000.0, 0.0)
    # 200 s for 40 steps make 300 s for 60 more, 30 of which have passed since the record was written
    assert found["running"].left == pytest.approx(270.0, abs=2)
    assert found["lost"].left == pytest.approx(900.0)
    assert found["failed"].left == 0.0
    assert found["paused"].left == pytest.approx(450.0)
    # the mean of 1000, 500, 1000, 1000 and 900 s that whole runs of this configuration take
    assert found["waiting"].left == pytest.approx(880.0)


def test_the_sums(jobs: list[Listed]) -> None:
    seen = overview(jobs)
    assert (seen.spent, seen.unknown, seen.ended) == (1800.0, 0, False)
    assert seen.left == pytest.approx(270 + 900 + 450 + 880, abs=2)
    assert overview(jobs[:1] + jobs[3:4]).ended


def test_curves_tell_how_far_a_run_is_since_its_last_checkpoint(jobs: list[Listed]) -> None:
    curves = jobs[1].folder / "curves.csv"
    curves.write_text("step,train/loss\n40,1.0\n60,0.5\n7")  # the last row is being written
    os.utime(curves, (time.time() - 10, time.time() - 10))
    running = by_state(jobs)["running"]
    assert running.steps == 60
    assert running.seconds == pytest.approx(220.0, abs=2)  # the record was written 30 s ago, the row 10 s ago
    assert running.left == pytest.approx(40 * 220 / 60 - 10, abs=3)


def test_a_run_before_its_first_checkpoint_has_the_speed_of_its_curves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    job = composed()[0]
    record(job.folder, "running", 0, 0.0, history=[{"started": when(500)}, {"started": when(50)}])
    assert overview([job.again()]).unknown == 1
    (job.folder / "curves.csv").write_text("step,train/loss\n1,1.0\n20,0.5\n")
    (running,) = overview([job.again()]).jobs
    assert (running.steps, running.left) == (20, pytest.approx(200.0, abs=5))


def test_what_nothing_tells_is_unknown_and_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    seen = overview([job.again() for job in composed()])
    assert (seen.unknown, seen.left) == (6, 0.0)
    text = status.summary(seen)
    assert text.splitlines()[0] == "6 jobs: 6 waiting."
    assert "unknown to go, since no run of the same configuration tells how long they take." in text


def rendered(jobs: list[Listed], width: int, most: int | None = None) -> str:
    text = io.StringIO()
    Console(file=text, width=width).print(status.drawn(overview(jobs), most))
    return text.getvalue()


def test_the_table_fits_a_narrow_terminal(jobs: list[Listed]) -> None:
    text = rendered(jobs, 80)
    assert max(map(len, text.splitlines())) <= 80
    rows = [row.split() for row in text.splitlines()[4:10]]
    name = jobs[0].name
    assert rows[0] == [name, "0", "finished", "100"]
    assert rows[1] == [name, "1", "running", "40/100", "4.5", "minutes"]
    assert rows[5] == [name, "5", "waiting", "0/100", "15", "minutes"]
    assert f"{name}, seed 3: No space left." in text
    assert "6 jobs: 1 waiting, 1 running, 1 lost, 1 paused, 1 failed, 1 finished." in text
    assert "Training: 30 minutes spent, about 42 minutes to go, one run at a time." in text
    assert max(map(len, rendered(jobs, 50).splitlines())) <= 50


def test_a_terminal_of_few_lines_shows_what_is_going_on(jobs: list[Listed]) -> None:
    text = rendered(jobs, 80, most=4)
    assert "waiting  " not in text
    assert "running" in text
    assert "... 2 more lines; --once prints all" in text


def test_seeds_that_wait_share_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = rendered([job.again() for job in composed()], 80)
    assert [row.split()[1:3] for row in text.splitlines() if "_smoke_" in row] == [["0-5", "waiting"]]


@pytest.fixture
def ask(command: Callable[..., Ended]) -> Callable[..., Ended]:
    return lambda *words: command("status", "--config-dir", CONF, *words)


JOB_KEYS = {
    *("name", "seed", "words", "folder", "state", "reason", "steps", "max_steps", "seconds_spent", "seconds_to_go"),
}


def test_json(jobs: list[Listed], ask: Callable[..., Ended]) -> None:
    ended = ask(*WORDS, "--json")
    assert (ended.code, ended.err) == (0, "")
    content = json.loads(ended.out)
    assert set(content) == {"counts", "seconds_spent", "seconds_to_go", "jobs_of_unknown_length", "jobs"}
    assert content["counts"] == dict.fromkeys(("finished", "running", "lost", "failed", "paused", "waiting"), 1)
    assert content["seconds_spent"] == 1800.0
    assert [set(job) for job in content["jobs"]] == [JOB_KEYS] * 6
    failed = content["jobs"][3]
    assert (failed["seed"], failed["state"], failed["reason"]) == (3, "failed", "No space left.")
    assert failed["words"][-1] == "seed=3"


def test_without_words_every_run_in_the_folder(jobs: list[Listed], ask: Callable[..., Ended], tmp_path: Path) -> None:
    old = tmp_path / "outputs" / "old_p2d_cpu_00000000" / "seed_0"
    record(old, "paused", 20, 30.0, outcome="paused")
    (old / "config.yaml").write_text("trainer: {max_steps: 80}\n")  # records of earlier versions have no max_steps
    content = json.loads(ask("--json").out)
    assert len(content["jobs"]) == 6  # the one that waits has no folder
    (paused,) = (job for job in content["jobs"] if job["name"] == "old_p2d_cpu_00000000")
    assert (paused["max_steps"], paused["seconds_to_go"]) == (80, 90.0)
    assert "6 jobs: 1 running, 1 lost, 2 paused, 1 failed, 1 finished." in ask("--once").out
    assert json.loads(ask("paths.outputs=nowhere", "--json").out)["jobs"] == []


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["scale=smok"], "did you mean 'smoke'?"),
        (["model=tiny", "data=squares", "scale=smoke", "trainer.max_step=3"], "did you mean 'trainer.max_steps'?"),
        (
            ["model=tiny", "data=squares", "scale=smoke", "trainer.max_steps=some"],
            "trainer.max_steps = 'some' is wrong",
        ),
        (["+sweep=nothing"], "sweep=nothing: there is no such choice"),
        (["seed=x"], "seed = 'x' is wrong"),
        (["--onc"], "unrecognized arguments: --onc."),
    ],
)
def test_wrong_words_are_one_sentence(words: list[str], told: str, ask: Callable[..., Ended]) -> None:
    ended = ask(*words)
    assert (ended.code, ended.out) == (2, "")
    assert told in ended.err
    assert len(ended.err.splitlines()) == 1


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_watching_ends_when_all_have_ended(jobs: list[Listed], monkeypatch: pytest.MonkeyPatch) -> None:
    states = iter([jobs[:2], jobs[:1]])
    monkeypatch.setattr(status, "INTERVAL", 0.0)
    terminal = Terminal()
    status.watch(lambda: overview(next(states)), Console(file=terminal, force_terminal=True, width=80, height=40))
    text = terminal.getvalue()
    assert text.index("1 running, 1 finished") < text.index("1 job: 1 finished")


def test_ctrl_c_ends_watching_without_an_error(
    jobs: list[Listed], monkeypatch: pytest.MonkeyPatch, command: Callable[..., Ended]
) -> None:
    monkeypatch.setattr(sys, "stdout", Terminal())

    def interrupt(seconds: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(status.time, "sleep", interrupt)
    monkeypatch.setattr(sys, "argv", ["status", "--config-dir", CONF, *WORDS])
    status.main()


def test_it_imports_no_pytorch() -> None:
    import subprocess

    code = "import sys, apex_lab.status; sys.exit('torch' in sys.modules or 'lightning' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


def test_states_are_read_again(jobs: list[Listed]) -> None:
    look = status.looking(WORDS, CONF)
    assert look().counts["paused"] == 1
    write_json(jobs[4].folder / "run.json", {"status": "finished", "steps": 100, "seconds": 900.0})
    write_json(jobs[4].folder / "metrics.json", {})
    assert (look().counts["paused"], look().counts["finished"]) == (0, 2)
    assert read_state(jobs[4].folder).state == "finished"
