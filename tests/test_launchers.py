"""Small sweeps under every launcher, in real processes: what ends how, what survives, what the exit code is."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from apex_lab.base.processes import alive
from tests.conftest import TINY

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

LONG = ("trainer.max_steps=40", "trainer.checkpoint_interval=39", "trainer.validation_interval=40")
"""Enough steps to be stopped among, none of them stored before the last but one."""

WORDS = {
    "joblib": ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2"),
    "submitit_local": ("hydra/launcher=submitit_local",),
    "ray": ("hydra/launcher=ray", "+hydra.launcher.ray.init={num_cpus: 2, include_dashboard: false}"),
}
MODULES = {"joblib": "joblib", "submitit_local": "submitit", "ray": "ray"}


@pytest.fixture(params=list(WORDS))
def launcher(request: pytest.FixtureRequest) -> str:
    name = str(request.param)
    plugin = f"hydra_plugins.hydra_{MODULES[name]}_launcher"
    if importlib.util.find_spec(plugin) is None:
        pytest.skip(f"{plugin} is not installed: pip install '.[launchers,ray]'")
    return name


class Swept:
    """A sweep in a process of its own.

    Attributes:
        process: of the command.
        out, err: what it said, once it has ended.
    """

    def __init__(self, folder: Path, *words: str, pause: float = 0.2) -> None:
        environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith(("APEX_LAB_", "SLURM_"))},
            "TINY_PAUSE": str(pause),
            "RAY_USAGE_STATS_ENABLED": "0",
        }
        self.folder = folder
        self.process = subprocess.Popen(
            [sys.executable, "-m", "apex_lab.train", *TINY, *words, "-m"],
            cwd=folder,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def end(self) -> int:
        """The exit code."""
        self.out, self.err = self.process.communicate(timeout=400)
        return self.process.returncode

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def sweep(tmp_path: Path) -> Iterator[Callable[..., Swept]]:
    """Starts a sweep in the test's folder: sweep("seed=0,1", launcher) -> `Swept`."""
    started: list[Swept] = []

    def start(launcher: str, *words: str, pause: float = 0.2) -> Swept:
        started.append(Swept(tmp_path, *words, *WORDS.get(launcher, ()), pause=pause))
        return started[-1]

    yield start
    for one in started:
        if one.process.poll() is None:
            one.kill()


def records(folder: Path) -> dict[int, dict[str, Any]]:
    """Seed -> record of its run."""
    found = {}
    for file in folder.glob("outputs/*/seed_*/run.json"):
        record = json.loads(file.read_text())
        found[int(record["seed"])] = record
    return found


def until(folder: Path, done: Callable[[dict[int, dict[str, Any]]], bool], seconds: float = 200.0) -> None:
    """Waits until the records of all runs are as told."""
    began = time.monotonic()
    while not done(records(folder)):
        assert time.monotonic() - began < seconds, {seed: r["status"] for seed, r in records(folder).items()}
        time.sleep(0.05)


def training(folder: Path) -> Callable[[dict[int, dict[str, Any]]], bool]:
    """Whether seed 0 makes steps: its curves have rows."""
    return lambda found: any(
        len(file.read_text().splitlines()) > 3 for file in folder.glob("outputs/*/seed_0/curves.csv")
    )


def stored(folder: Path, seed: int) -> int:
    """Step of a run's last checkpoint."""
    [file] = folder.glob(f"outputs/*/seed_{seed}/checkpoints/last.ckpt")
    return int(torch.load(file, weights_only=True)["step"])


def test_failures_end_no_other_job_and_are_listed(launcher: str, sweep: Callable[..., Swept], tmp_path: Path) -> None:
    ended = sweep(launcher, "seed=0,1", "optimizer.lr=0.01,1e30", pause=0.0)
    assert ended.end() == 1, ended.err
    assert "4 jobs: 2 finished, 2 failed." in ended.out
    listed = ended.err.splitlines()[-3:]
    assert listed[0] == "2 of 4 failed:"
    assert [", seed 0: train/loss is nan" in listed[1], ", seed 1: train/loss is nan" in listed[2]] == [True, True]
    again = sweep(launcher, "seed=0,1", "optimizer.lr=0.01,1e30", pause=0.0)
    assert again.end() == 1
    assert "2 finished, 2 failed before, 0 of 4 jobs to run." in again.out
    assert again.err.count("hydra.sweeper.retry_failed=true tries it again") == 2


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_stopped_sweep_stores_every_step_and_goes_on(
    launcher: str, number: signal.Signals, sweep: Callable[..., Swept], tmp_path: Path
) -> None:
    first = sweep(launcher, *LONG, "seed=0,1")
    until(tmp_path, training(tmp_path))
    first.process.send_signal(number)
    assert first.end() == 128 + number, first.err
    assert f"Stopped by {number.name}" in first.err
    for seed, record in records(tmp_path).items():
        assert (record["status"], record["outcome"]) == ("failed", "interrupted"), seed
        assert not alive(record["pid"])
    assert 0 < stored(tmp_path, 0) == records(tmp_path)[0]["steps"] < 39
    second = sweep(launcher, *LONG, "seed=0,1", pause=0.0)
    assert second.end() == 0, second.err
    assert {record["status"] for record in records(tmp_path).values()} == {"finished"}
    assert {record["steps"] for record in records(tmp_path).values()} == {40}


def test_a_killed_job_fails_alone(launcher: str, sweep: Callable[..., Swept], tmp_path: Path) -> None:
    ended = sweep(launcher, *LONG, "seed=0,1")
    until(tmp_path, training(tmp_path))
    os.kill(records(tmp_path)[0]["pid"], signal.SIGKILL)
    assert ended.end() == 1, ended.err
    assert records(tmp_path)[1]["status"] == "finished"
    assert "seed 0: its process was ended by SIGKILL; the machine may have run out of memory" in ended.err
    assert "2 jobs: 1 failed, 1 finished." in ended.out or "2 jobs: 1 finished, 1 failed." in ended.out
    again = sweep(launcher, *LONG, "seed=0,1", pause=0.0)
    assert again.end() == 0, again.err
    assert records(tmp_path)[0]["steps"] == 40


def test_jobs_end_with_a_sweep_that_is_killed(launcher: str, sweep: Callable[..., Swept], tmp_path: Path) -> None:
    first = sweep(launcher, *LONG, "seed=0,1,2", "trainer.max_steps=100")
    until(tmp_path, training(tmp_path))
    first.kill()
    pids = [record["pid"] for record in records(tmp_path).values()]
    began = time.monotonic()
    while any(map(alive, pids)):
        assert time.monotonic() - began < 30
        time.sleep(0.1)
    if launcher != "ray":  # Ray kills what its workers have started
        assert {record["outcome"] for record in records(tmp_path).values()} == {"interrupted"}
        assert stored(tmp_path, 0) > 0
    again = sweep(launcher, *LONG, "seed=0,1,2", "trainer.max_steps=100", pause=0.0)
    assert again.end() == 0, again.err
    assert [record["steps"] for record in records(tmp_path).values()] == [100] * 3


def test_one_run_with_two_processes(launcher: str, sweep: Callable[..., Swept], tmp_path: Path) -> None:
    ended = sweep(launcher, "trainer.devices=2", "seed=0,1", pause=0.0)
    assert ended.end() == 0, ended.err
    assert {record["steps"] for record in records(tmp_path).values()} == {6}


def test_two_sweeps_at_once(sweep: Callable[..., Swept], tmp_path: Path) -> None:
    both = [sweep("joblib", *LONG, "seed=0,1"), sweep("basic", *LONG, "seed=0,1")]
    assert [one.end() for one in both] == [0, 0], [one.err for one in both]
    assert all(len(record["history"]) == 1 for record in records(tmp_path).values())
    assert any("waiting for" in one.out or "waits for" in one.out for one in both)


def test_the_death_of_a_worker_of_joblib(sweep: Callable[..., Swept], tmp_path: Path) -> None:
    ended = sweep("joblib", *LONG, "seed=0,1")
    until(tmp_path, training(tmp_path))
    job = records(tmp_path)[0]["pid"]
    worker = int(Path(f"/proc/{job}/stat").read_text().rpartition(")")[2].split()[1])
    os.kill(worker, signal.SIGKILL)
    assert ended.end() == 0, ended.err  # joblib gives all workers up; the jobs are launched once more
    assert "the launcher ended with TerminatedWorkerError" in ended.err
    assert [record["steps"] for record in records(tmp_path).values()] == [40, 40]


def test_a_preempted_job_of_submitit_is_started_again(sweep: Callable[..., Swept], tmp_path: Path) -> None:
    pytest.importorskip("submitit")
    ended = sweep("submitit_local", *LONG, "seed=0")
    until(tmp_path, training(tmp_path))
    job = records(tmp_path)[0]["pid"]
    worker = int(Path(f"/proc/{job}/stat").read_text().rpartition(")")[2].split()[1])
    os.kill(worker, signal.SIGUSR2)  # what Slurm sends before it takes the machine away
    until(tmp_path, lambda found: found[0]["outcome"] == "interrupted")
    assert 0 < stored(tmp_path, 0) < 39
    assert ended.end() == 0, ended.err
    record = records(tmp_path)[0]
    assert (record["status"], record["steps"], len(record["history"])) == ("finished", 40, 2)
    assert "resuming from step" in (next(tmp_path.glob("outputs/*/seed_0")) / "log.txt").read_text()
