"""Runs that are asked to stop, run out of time, or stop early: what is stored, how they end, what resuming gives."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning as L
import pytest
import torch

from apex_lab.config import command_line
from apex_lab.runs import checkpoints
from tests import tiny
from tests.conftest import TINY, Ended, compose_job, train_in, wait_for_step
from tests.test_train import curves, equal, record

Q = (
    "trainer.max_steps=40",
    "trainer.log_interval=5",
    "trainer.checkpoint_interval=10",
    "trainer.validation_interval=20",
)
SLURM = {
    "SLURM_NTASKS": "1",
    "SLURM_JOB_NAME": "train",
    "SLURM_JOB_ID": "4242",
    "SLURM_PROCID": "0",
    "SLURM_LOCALID": "0",
    "SLURM_NODEID": "0",
    "SLURM_NODELIST": "localhost",
}
CLUSTERS = {
    "Slurm": SLURM,
    "two tasks": {**SLURM, "SLURM_NTASKS": "2"},
    "an interactive shell": {**SLURM, "SLURM_NTASKS": "4", "SLURM_JOB_NAME": "interactive"},
    "the second task": {**SLURM, "SLURM_NTASKS": "2", "SLURM_PROCID": "1", "SLURM_LOCALID": "1"},
    "LSF": {"LSB_JOBID": "1", "LSB_DJOB_RANKFILE": "/nowhere", "JSM_NAMESPACE_SIZE": "2", "JSM_NAMESPACE_RANK": "1"},
    "Kubeflow": {"KUBERNETES_PORT": "tcp://127.0.0.1:443", "MASTER_ADDR": "localhost", "MASTER_PORT": "1"},
    "MPI": {"OMPI_COMM_WORLD_SIZE": "2", "OMPI_COMM_WORLD_RANK": "1", "PMI_SIZE": "2", "PMI_RANK": "1"},
    "a stray rank": {"LOCAL_RANK": "1", "NODE_RANK": "1", "GROUP_RANK": "1"},
}


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run that nothing stops."""
    return next(train_in(tmp_path_factory.mktemp("unbroken"), *TINY, *Q).glob("*/seed_0"))


@pytest.fixture
def at(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Does something once, when a split's video is read for the nth time: at("val", 3, do)."""

    def patch(split: str, reading: int, do: Callable[[], object]) -> None:
        kind = tiny.TrainingSquares if split == "train" else tiny.Squares
        real, readings = kind.read, [0]

        def read(self: Any, clip: Any) -> dict[str, torch.Tensor]:
            if self.split == split:
                readings[0] += 1
                if readings[0] == reading:
                    do()
            return real(self, clip)

        monkeypatch.setattr(kind, "read", read)

    return patch


def ask(number: int) -> Callable[[], None]:
    return lambda: os.kill(os.getpid(), number)


def job(again: bool = False, **more: object) -> SimpleNamespace:
    return SimpleNamespace(asked=SimpleNamespace(again=again), **more)


@pytest.mark.parametrize(
    ("entry", "asked", "resumes"),
    [
        ("train", job(), True),
        ("bench", job(), False),
        ("compare", job(), False),
        ("arrange", job(), True),
        ("arrange", job(again=True), False),
        ("evaluate", job(predictions=None), True),
        ("evaluate", job(predictions=None, again=True), False),
        ("evaluate", job(predictions="other.npz"), False),
        ("predict", job(videos=("clip.mp4",)), True),
        ("predict", job(videos=("clip.mp4",), again=True), False),
        ("predict", job(videos=(0,)), False),  # a camera shows something else then
    ],
)
def test_a_command_says_that_it_resumes_where_it_does(
    entry: str, asked: SimpleNamespace, resumes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    launched: list[command_line.Command] = []
    monkeypatch.setattr(command_line, "launch", launched.append)
    importlib.import_module(f"apex_lab.{entry}").main()
    assert launched[0].resumes(asked) is resumes


def stopped(run: Path, step: int, name: str) -> None:
    """A run was asked to stop, and has stored a step."""
    about = record(run)
    assert (about["status"], about["outcome"]) == ("failed", "interrupted")
    assert about["reason"] == f"stopped by {name}"
    stored = checkpoints.load(run / "checkpoints" / "last.ckpt", trusted=True)
    assert stored["step"] == about["steps"] == step


def test_under_slurm_a_warned_and_killed_run_ends_as_unbroken(
    train: Callable[..., Ended],
    at: Callable[..., None],
    unbroken: Path,
    the_run: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in SLURM.items():
        monkeypatch.setenv(name, value)
    at("train", 2 * 15, ask(signal.SIGUSR1))  # two clips a step
    ended = train(*Q)
    assert ended.code == 128 + signal.SIGUSR1
    assert "Stopped by SIGUSR1; the same command resumes from here." in ended.err
    run = the_run()
    stopped(run, 15, "SIGUSR1")
    # what Lightning itself would leave there, and load
    torch.save({"state_dict": {}, "pytorch-lightning_version": L.__version__, "epoch": 9}, run / "hpc_ckpt_1.ckpt")
    monkeypatch.setenv("TINY_BROKEN_AT", "10")  # steps after the 15th: the second end, after 25
    assert train(*Q).code == 1
    assert record(run)["steps"] == 20
    monkeypatch.delenv("TINY_BROKEN_AT")
    assert train(*Q).code == 0
    assert record(run)["steps"] == 40
    equal(run, unbroken)


@pytest.mark.slow
def test_under_slurm_a_killed_process_ends_as_unbroken(
    train: Callable[..., Ended], unbroken: Path, tmp_path: Path
) -> None:
    for step, number in ((15, signal.SIGUSR1), (25, signal.SIGKILL)):
        process = start(tmp_path, *Q, "trainer.checkpoint_interval=5", **SLURM)
        run = wait_for_step(tmp_path, step)
        process.send_signal(number)
        process.communicate()
        assert process.returncode == (138 if number == signal.SIGUSR1 else -9)
    assert not list(run.rglob("hpc_ckpt*"))
    process = start(tmp_path, *Q, "trainer.checkpoint_interval=5", **SLURM)
    _, err = process.communicate()
    assert process.returncode == 0, err
    equal(run, unbroken)


@pytest.mark.parametrize(
    "cluster", [name if name == "two tasks" else pytest.param(name, marks=pytest.mark.slow) for name in CLUSTERS]
)
def test_variables_of_a_cluster_change_nothing(
    cluster: str, train: Callable[..., Ended], the_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in CLUSTERS[cluster].items():
        monkeypatch.setenv(name, value)
    ended = train("trainer.max_steps=2", "trainer.validation_interval=2")
    assert (ended.code, ended.err) == (0, "")
    assert record(the_run())["steps"] == 2


def test_ranks_that_do_not_fit_are_refused(
    train: Callable[..., Ended], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"RANK": "0", "WORLD_SIZE": "2"}.items():
        monkeypatch.setenv(name, value)
    ended = train()
    assert ended.code == 1
    assert "2 processes were started (WORLD_SIZE), but trainer.devices = 1" in ended.err
    assert len(ended.err.splitlines()) == 1
    assert not (tmp_path / "outputs").exists()


@pytest.mark.parametrize(
    ("step", "number"),
    [
        (20, signal.SIGTERM),
        (40, signal.SIGUSR1),
        pytest.param(20, signal.SIGINT, marks=pytest.mark.slow),
        pytest.param(40, signal.SIGTERM, marks=pytest.mark.slow),
    ],
)
def test_asked_to_stop_in_validation_it_stores_the_validated_step(
    step: int,
    number: signal.Signals,
    train: Callable[..., Ended],
    at: Callable[..., None],
    unbroken: Path,
    the_run: Callable[..., Path],
) -> None:
    at("val", 1 if step == 20 else 3, ask(number))  # the first of two videos
    ended = train(*Q)
    assert ended.code == 128 + number
    stopped(the_run(), step, number.name)
    validated = next(row for row in curves(unbroken) if row["step"] == str(step))
    assert curves(the_run())[-1]["val/loss"] == validated["val/loss"] != ""
    assert train(*Q).code == 0
    equal(the_run(), unbroken)


def test_a_request_swallowed_in_training_acts_when_the_step_is_stored(
    train: Callable[..., Ended], at: Callable[..., None], unbroken: Path, the_run: Callable[..., Path]
) -> None:
    class Dying:
        def __del__(self) -> None:
            ask(signal.SIGTERM)()

    at("train", 2 * 13, Dying)
    assert train(*Q).code == 143
    stopped(the_run(), 13, "SIGTERM")
    assert train(*Q).code == 0
    equal(the_run(), unbroken)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_request_swallowed_after_training_stops_the_evaluation_and_the_next_jobs(
    train: Callable[..., Ended], at: Callable[..., None], tmp_path: Path, the_run: Callable[..., Path]
) -> None:
    class Dying:
        def __del__(self) -> None:
            ask(signal.SIGTERM)()
            for _ in range(100):
                pass

    at("test", 1, Dying)
    ended = train("seed=0,1", "-m")
    assert ended.code == 143
    assert record(the_run(0))["reason"] == "stopped by SIGTERM"
    assert not (the_run(0) / "metrics.json").exists()
    assert not list(tmp_path.glob("outputs/*/seed_1"))
    assert train("seed=0,1", "-m").code == 0


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_request_swallowed_at_the_very_end_leaves_a_finished_run_and_ends_the_sweep(
    train: Callable[..., Ended], tmp_path: Path, the_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Dying:
        def __del__(self) -> None:
            ask(signal.SIGTERM)()
            for _ in range(100):
                pass

    monkeypatch.setattr("apex_lab.train._show", lambda run: Dying())
    assert train("seed=0,1", "-m").code == 143
    assert record(the_run(0))["status"] == "finished"
    assert not list(tmp_path.glob("outputs/*/seed_1"))


def start(folder: Path, *words: str, **variables: str) -> subprocess.Popen[str]:
    """Trains in a process group of its own."""
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "TINY_PAUSE": "0.2",
    }
    return subprocess.Popen(
        [sys.executable, "-c", "from apex_lab.train import main; main()", *TINY, *words],
        cwd=folder,
        env={**environment, **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


@pytest.mark.slow
def test_a_signal_to_all_processes_of_a_job_stores_the_step_too(
    train: Callable[..., Ended], unbroken: Path, tmp_path: Path
) -> None:
    process = start(tmp_path, *Q, "++data.workers=2", "trainer.checkpoint_interval=5")
    run = wait_for_step(tmp_path, 10)
    time.sleep(0.1)
    os.killpg(process.pid, signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 143, err
    assert record(run)["reason"] == "stopped by SIGTERM"
    assert record(run)["steps"] % 5  # a step between two checkpoints
    assert train(*Q).code == 0
    equal(run, unbroken)


def test_a_run_goes_on_slice_by_slice(
    train: Callable[..., Ended], unbroken: Path, the_run: Callable[..., Path], tmp_path: Path
) -> None:
    """Each slice is over after its first step that ends late; 1e-6 minutes are one step each."""
    few = ("trainer.max_minutes=1e-6",)
    ended = train(*Q, *few)
    assert ended.code == 0
    assert ended.out.splitlines()[-1] == (
        "paused at step 1: stopped after 1e-06 minutes (trainer.max_minutes); the same command resumes."
    )
    about = record(the_run())
    assert (about["status"], about["outcome"], about["steps"]) == ("paused", "paused", 1)
    assert about["reason"] == "stopped after 1e-06 minutes (trainer.max_minutes)"
    assert not (the_run() / "metrics.json").exists()
    assert train(*Q, *few).code == 0
    assert record(the_run())["steps"] == 2
    assert train(*Q, "trainer.max_minutes=60").code == 0
    assert record(the_run())["status"] == "finished"
    equal(the_run(), unbroken)


def test_a_slice_that_ends_with_training_is_no_pause(train: Callable[..., Ended], the_run: Callable[..., Path]) -> None:
    words = ("trainer.max_steps=3", "trainer.validation_interval=2", "trainer.max_minutes=1e-6")
    for step in (1, 2):  # the second stops after the validation that is due
        assert train(*words).code == 0
        assert record(the_run())["steps"] == step
    assert "val/ari_fg" in curves(the_run())[-1]
    assert train(*words).code == 0
    assert (record(the_run())["status"], record(the_run())["steps"]) == ("finished", 3)


def test_tables_see_a_paused_run_as_unfinished(train: Callable[..., Ended], the_run: Callable[..., Path]) -> None:
    from apex_lab.tables.found import read_run

    train("trainer.max_minutes=1e-6")
    found = read_run(the_run(), 0)
    assert found is not None
    assert found.state == "unfinished"
    assert found.why == "its last word is: stopped after 1e-06 minutes (trainer.max_minutes)."


EARLY = (
    *Q,
    "trainer.validation_interval=3",
    "+callbacks.early_stopping._target_=lightning.pytorch.callbacks.EarlyStopping",
    "+callbacks.early_stopping.monitor=val/loss",
    "+callbacks.early_stopping.mode=min",
    "+callbacks.early_stopping.patience=2",
    "+callbacks.early_stopping.min_delta=1000000.0",  # nothing but the first value is an improvement
)


@pytest.fixture(scope="module")
def stopped_early(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run that early stopping alone has stopped."""
    return next(train_in(tmp_path_factory.mktemp("early"), *TINY, *EARLY).glob("*/seed_0"))


@pytest.mark.parametrize("stop", [7, 6, *(pytest.param(step, marks=pytest.mark.slow) for step in (1, 3, 9))])
def test_early_stopping_stops_where_it_does_unbroken(
    stop: int,
    train: Callable[..., Ended],
    at: Callable[..., None],
    the_run: Callable[..., Path],
    stopped_early: Path,
) -> None:
    assert (record(stopped_early)["status"], record(stopped_early)["steps"]) == ("finished", 9)
    at("train", 2 * stop, ask(signal.SIGTERM))
    assert train(*EARLY).code == 143
    stopped(the_run(), stop, "SIGTERM")
    assert train(*EARLY).code == 0
    assert record(the_run())["steps"] == 9
    equal(the_run(), stopped_early)


class Counting(L.Callback):
    """A user's callback with a state, which counts the steps that it has seen, and logs them."""

    def __init__(self, kind: str = "plain") -> None:
        self.kind, self.steps = kind, 0

    def state_dict(self) -> dict[str, Any]:
        return {"steps": self.steps} if self.kind == "plain" else {"steps": Path("steps")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.steps = state["steps"]

    def on_fit_start(self, trainer: L.Trainer, learner: L.LightningModule) -> None:
        assert self.steps == learner.step  # the state is there before anything begins

    def on_train_batch_end(self, trainer: L.Trainer, learner: L.LightningModule, *_: Any) -> None:
        self.steps += 1
        learner.log("counted", float(self.steps))


COUNTING = ("+callbacks.counting._target_=tests.test_stops.Counting",)


def test_callbacks_of_a_user_keep_their_state_and_their_step(
    train: Callable[..., Ended],
    at: Callable[..., None],
    the_run: Callable[..., Path],
    tmp_path: Path,
) -> None:
    words = (*COUNTING, "+callbacks.rates._target_=lightning.pytorch.callbacks.LearningRateMonitor", "seed=0")
    assert train(*words, "paths.outputs=whole").code == 0
    at("train", 2 * 4, ask(signal.SIGTERM))
    assert train(*words).code == 143
    assert train(*words).code == 0
    stored = torch.load(the_run() / "checkpoints" / "last.ckpt", weights_only=True)["training"]["callbacks"]
    assert stored == {"Counting": {"steps": 6}}
    ours, theirs = (
        [{k: v for k, v in row.items() if k != "train/frames_per_second"} for row in curves(run)]
        for run in (the_run(), next(tmp_path.glob("whole/*/seed_0")))
    )
    assert ours == theirs
    steps = [int(row["step"]) for row in ours]
    assert steps == sorted(set(steps))


def test_a_state_that_a_checkpoint_cannot_hold_is_refused_before_the_first_step(
    train: Callable[..., Ended], the_run: Callable[..., Path]
) -> None:
    ended = train(*COUNTING, "+callbacks.counting.kind=path")
    assert ended.code == 1
    assert ended.err == (
        "The state of Counting cannot be stored: let its state_dict() give plain values and tensors alone, "
        "which a checkpoint can hold without running code.\n"
    )
    assert record(the_run())["steps"] == 0


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["+callbacks.own._target_=lightning.pytorch.callbacks.ModelCheckpoint"],
            "callbacks.own: a run keeps its checkpoints itself",
        ),
        (
            [
                "+callbacks.early._target_=lightning.pytorch.callbacks.EarlyStopping",
                "+callbacks.early.monitor=val/arifg",
            ],
            "callbacks.early.monitor = 'val/arifg' is none of val/ari_fg",
        ),
        (
            [
                "+callbacks.early._target_=lightning.pytorch.callbacks.EarlyStopping",
                "+callbacks.early.monitor=val/ari",
                "trainer.validation_interval=null",
            ],
            "callbacks.early looks at validation's scores: set trainer.validation_interval",
        ),
        (["trainer.max_minutes=0"], "trainer.max_minutes"),
    ],
)
def test_what_cannot_work_is_refused_at_once(
    words: list[str], sentence: str, train: Callable[..., Ended], tmp_path: Path
) -> None:
    ended = train(*words)
    assert ended.code == 2
    assert sentence in ended.err
    assert len(ended.err.splitlines()) == 1
    assert not (tmp_path / "outputs").exists()


def test_time_limits_do_not_rename_runs() -> None:
    from apex_lab.runs.folder import group_name

    assert group_name(compose_job("trainer.max_minutes=5")) == group_name(compose_job())
    assert json.dumps(compose_job().raw["trainer"]["max_minutes"]) == "null"
