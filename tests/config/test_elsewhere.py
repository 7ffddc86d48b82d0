"""A worker of a launcher and the job that it starts: outcomes, lines, requests to stop."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock
from omegaconf import OmegaConf

from apex_lab.base import console, slots
from apex_lab.base.interrupts import Interrupted
from apex_lab.config import command_line, elsewhere
from apex_lab.config.elsewhere import Origin, relaying
from apex_lab.config.sweeps import Item, JobBusy, JobFailed, JobStopped, Sweep
from tests.conftest import REPOSITORY

JOB = """
import os, signal, sys, time
from apex_lab.base import attached

def stop(signum, frame):
    print("storing")
    attached.tell("interrupted", signal.Signals(signum).name)
    sys.exit(128 + signum)

for number in (signal.SIGTERM, signal.SIGINT, signal.SIGUSR2):
    signal.signal(number, stop)
attached.listen()
word = sys.argv[1]
print(f"pid {os.getpid()}", flush=True)
if word == "how=killed":
    os.kill(os.getpid(), signal.SIGKILL)
elif word == "how=crashed":
    sys.exit("a crash")
elif word == "how=long":
    open("running", "w").close()
    time.sleep(60)
else:
    attached.tell(word.removeprefix("how="), "the reason")
"""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Does a job in the way of a worker: run("how=finished") -> how it ended."""
    (tmp_path / "apex_fake_job.py").write_text(JOB)
    monkeypatch.setattr(slots, "folder", lambda: tmp_path / "slots")
    monkeypatch.delenv("SUBMITIT_EXECUTOR", raising=False)
    console.setup()

    def start(word: str, **changes: Any) -> str:
        config = {
            "overrides": {"task": [word, "model=x"], "hydra": ["hydra.launcher.n_jobs=1", "hydra.sweeper.slots=1"]},
            "sweeper": {"slots": 1},
            "launcher": {"n_jobs": 1},
            "sweep": {"dir": "sweep"},
        }
        node = OmegaConf.create(config)
        monkeypatch.setattr(elsewhere.HydraConfig, "get", staticmethod(lambda: node))
        origin = Origin.here("apex_fake_job", (), [(word, "model=x"), ("other", "model=x")])
        path = (str(tmp_path), str(REPOSITORY / "src"))
        return elsewhere.run(replace(origin, folder=str(tmp_path), path=path, **changes))

    return start


def when_running(folder: Path, act: Callable[[], object]) -> None:
    """Acts once the long job is at work."""

    def wait() -> None:
        while not (folder / "running").exists():
            time.sleep(0.01)
        (folder / "running").unlink()
        act()

    threading.Thread(target=wait, daemon=True).start()


def test_outcomes_come_back(run: Callable[..., str], capfd: pytest.CaptureFixture[str]) -> None:
    assert run("how=finished") == "finished"
    assert capfd.readouterr().out.startswith("[how=finished] pid ")
    assert run("how=paused") == "paused"
    with pytest.raises(JobFailed, match=r"^the reason$"):
        run("how=failed")
    with pytest.raises(JobBusy, match=r"^the reason$"):
        run("how=busy")
    with pytest.raises(JobFailed, match=r"its process was ended by SIGKILL; the machine may have run out of memory"):
        run("how=killed")
    capfd.readouterr()
    with pytest.raises(JobFailed, match=r"its process ended with exit code 1 and no word: see its messages"):
        run("how=crashed")
    assert capfd.readouterr().err == "[how=crashed] a crash\n"


def test_a_signal_to_the_worker_reaches_the_job_once(
    run: Callable[..., str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    before = signal.getsignal(signal.SIGUSR2)
    for number in (signal.SIGUSR2, signal.SIGINT):
        when_running(tmp_path, partial(os.kill, os.getpid(), number))
        with pytest.raises(JobStopped) as stopped:
            run("how=long")
        assert (stopped.value.signum, str(stopped.value)) == (number, f"stopped by {number.name}")
        assert capfd.readouterr().out.count("storing") == 1
    assert signal.getsignal(signal.SIGUSR2) == before


def test_a_request_to_the_sweep_reaches_jobs_through_its_file(run: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "sweep").mkdir()
    when_running(tmp_path, partial((tmp_path / "sweep" / "stop").write_text, "15"))
    with pytest.raises(JobStopped, match="SIGTERM"):
        run("how=long", stop="stop")
    began = time.monotonic()
    with pytest.raises(JobStopped):
        run("how=long", stop="stop")  # a job that has not started does not start
    assert time.monotonic() - began < 0.1


def test_jobs_stop_when_the_sweep_has_died(run: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> None:
    dead = subprocess.Popen(["true"])
    dead.wait()
    with pytest.raises(JobStopped, match="SIGTERM"):
        run("how=long", pid=dead.pid)
    monkeypatch.setenv("SUBMITIT_EXECUTOR", "slurm")
    assert run("how=finished", pid=dead.pid) == "finished"  # jobs in a queue outlive it
    monkeypatch.delenv("SUBMITIT_EXECUTOR")
    assert run("how=finished", pid=dead.pid, host="elsewhere") == "finished"


def test_submitit_acts_when_the_job_is_stored(
    run: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    came: list[int] = []

    def requeue(signum: int, frame: object) -> None:
        assert "storing" in capfd.readouterr().out
        came.append(signum)
        sys.exit(-1)

    monkeypatch.setenv("SUBMITIT_EXECUTOR", "slurm")
    before = signal.signal(signal.SIGUSR2, requeue)
    try:
        when_running(tmp_path, partial(os.kill, os.getpid(), signal.SIGUSR2))
        with pytest.raises(SystemExit):
            run("how=long")
        assert came == [signal.SIGUSR2]
        when_running(tmp_path, partial(os.kill, os.getpid(), signal.SIGTERM))
        with pytest.raises(SystemExit) as ended:  # no result, so submitit waits for Slurm to start it again
            run("how=long")
        assert ended.value.code == 143
    finally:
        signal.signal(signal.SIGUSR2, before)


def test_a_job_waits_for_its_slot(
    run: Callable[..., str], tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    [slot] = slots.machine(1)
    (tmp_path / "slots").mkdir()
    owner = FileLock(tmp_path / "slots" / f"{slot.name}_0.lock", blocking=False)
    owner.acquire()
    monkeypatch.setattr(slots.time, "sleep", lambda seconds: owner.release())
    assert run("how=finished") == "finished"
    lines = capfd.readouterr().out.splitlines()
    assert lines[0].startswith("[how=finished] waits for a free slot on ")
    assert lines[1].startswith("[how=finished] pid ")


def test_the_first_request_goes_to_the_jobs_and_the_second_stops(tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGTERM)
    stop = tmp_path / "sweep" / "stop"

    def once() -> None:
        with relaying(stop, (signal.SIGINT, signal.SIGTERM)):
            os.kill(os.getpid(), signal.SIGTERM)  # another thread takes it
            time.sleep(0.05)
            assert stop.read_text() == "15"

    with pytest.raises(Interrupted) as stopped:
        once()
    assert stopped.value.signum == signal.SIGTERM
    assert not stop.exists()
    assert signal.getsignal(signal.SIGTERM) == before

    def twice() -> None:
        with relaying(stop, ()):
            os.kill(os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGTERM)
            raise AssertionError("went on")

    with pytest.raises(Interrupted):
        twice()
    assert stop.exists()  # jobs that a queue starts later do not start


def test_other_processes_get_no_lists_of_jobs() -> None:
    items = [Item((f"seed={seed}", "x" * 100), object(), "title") for seed in range(1000)]
    origin = Origin.here("apex_lab.train", (), [item.words for item in items])
    task = command_line._Task(origin, lambda config: "done here", Sweep(items))
    assert task(OmegaConf.create()) == "done here"
    sent = pickle.dumps(task)
    assert len(sent) < 10_000
    got = pickle.loads(sent)
    assert (got.origin, got.do, got.sweep) == (origin, None, None)
