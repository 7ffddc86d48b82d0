"""Two processes that share each batch train what one process trains, leave one run folder, and resume as one does."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from apex_lab.base.errors import UserError
from apex_lab.training.ranks import Ranks, check_given, given, started
from tests.conftest import TINY, Ended, train_in

WORDS = (
    *TINY,
    "trainer.max_steps=20",
    "trainer.log_interval=1",
    "trainer.validation_interval=10",
    "trainer.checkpoint_interval=2",
)


def start(folder: Path, *words: str, pause: float = 0.0) -> subprocess.Popen[str]:
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "TINY_PAUSE": str(pause),
    }
    program = (sys.executable, "-m", "apex_lab.train", *WORDS, *words)
    return subprocess.Popen(
        program, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def rows(folder: Path) -> list[dict[str, str]]:
    [path] = folder.glob("*/seed_0/curves.csv")
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def weights(folder: Path) -> dict[str, torch.Tensor]:
    [path] = folder.glob("*/seed_0/checkpoints/last.ckpt")
    return torch.load(path, weights_only=True)["inference"]["weights"]


@pytest.fixture(scope="module")
def one_process(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train_in(tmp_path_factory.mktemp("one"), *WORDS)


def equal(ours: Path, theirs: Path) -> None:
    """Losses of all steps and validation scores agree to rounding, and so do the weights."""
    assert len(rows(ours)) == len(rows(theirs)) == 20
    for a, b in zip(rows(ours), rows(theirs), strict=True):
        assert a["step"] == b["step"]
        for name in ("train/loss", "train/gradient_norm", "val/loss", "val/ari_fg", "val/msc"):
            assert (a[name] == "") == (b[name] == ""), (a["step"], name)
            if a[name]:
                assert float(a[name]) == pytest.approx(float(b[name]), rel=1e-4), (a["step"], name)
    for name, weight in weights(theirs).items():
        torch.testing.assert_close(weights(ours)[name], weight, rtol=1e-3, atol=1e-5)


@pytest.mark.slow
def test_two_processes_train_what_one_trains(one_process: Path, tmp_path: Path) -> None:
    process = start(tmp_path, "trainer.devices=2")
    out, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors
    assert errors == ""
    assert out.count("validation:") == 2
    equal(tmp_path / "outputs", one_process)


@pytest.mark.parametrize("kill", [pytest.param(signal.SIGKILL, marks=pytest.mark.slow), signal.SIGTERM])
def test_killed_and_resumed_they_end_as_unbroken(
    one_process: Path, tmp_path: Path, kill: signal.Signals, command: Callable[..., Ended]
) -> None:
    process = start(tmp_path, "trainer.devices=2", pause=0.1)
    for _ in range(2000):
        records = [json.loads(path.read_text()) for path in tmp_path.glob("outputs/*/seed_0/run.json")]
        if records and records[0]["steps"] >= 4:
            break
        time.sleep(0.05)
        assert process.poll() is None, process.communicate()[1]
    process.send_signal(kill)
    process.communicate(timeout=60)
    assert process.returncode == (-9 if kill == signal.SIGKILL else 143)
    [record] = [json.loads(path.read_text()) for path in tmp_path.glob("outputs/*/seed_0/run.json")]
    assert 4 <= record["steps"] < 20
    assert record["outcome"] == (None if kill == signal.SIGKILL else "interrupted")
    for _ in range(200):  # the other process ends with the one that started it
        if not _workers(tmp_path):
            break
        time.sleep(0.05)
    assert not _workers(tmp_path)
    ended = command("train", *WORDS, "trainer.devices=2")  # rank 0 in this process
    assert ended.code == 0, ended.err
    assert "resuming from step" in ended.out
    equal(tmp_path / "outputs", one_process)
    # the number of processes does not change the name of a run
    assert [path.name for path in (tmp_path / "outputs").iterdir()] == [path.name for path in one_process.iterdir()]


@pytest.mark.slow
def test_callbacks_and_time_limits_stop_all_ranks_at_once(tmp_path: Path) -> None:
    early = (
        "trainer.devices=2",
        "trainer.validation_interval=3",
        "+callbacks.early._target_=lightning.pytorch.callbacks.EarlyStopping",
        "+callbacks.early.monitor=val/loss",
        "+callbacks.early.patience=2",
        "+callbacks.early.min_delta=1000000.0",
    )
    for words, status, step in ((("trainer.max_minutes=1e-6",), "paused", 1), ((), "finished", 9)):
        process = start(tmp_path, *early, *words)
        _, errors = process.communicate(timeout=200)
        assert process.returncode == 0, errors
        [record] = [json.loads(path.read_text()) for path in tmp_path.glob("outputs/*/seed_0/run.json")]
        assert (record["status"], record["steps"]) == (status, step)
    assert not _workers(tmp_path)


@pytest.mark.slow
def test_ranks_look_together_at_what_is_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With values looked at two updates later, as on GPUs: rank 0 alone stores the second step, which is not finite."""
    late = tmp_path / "late" / "sitecustomize.py"
    late.parent.mkdir()
    late.write_text(
        "from apex_lab.training.watch import LAG, Watch\n"
        "look = Watch.look\n"
        "Watch.look = lambda self, lag=None: look(self, 0 if lag is None else LAG)\n"
    )
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(late.parent), os.environ["PYTHONPATH"]]))
    broken = "loss.error={_target_: apex_lab.training.schedules.Linear, start: 1.0, end: 1e38, steps: 1}"
    process = start(tmp_path, "trainer.devices=2", "trainer.log_interval=100", broken)
    _, errors = process.communicate(timeout=200)
    assert process.returncode == 1
    assert "train/loss is inf at step 2 " in errors
    assert list(tmp_path.glob("outputs/*/seed_0/diverged.npz"))
    assert not list(tmp_path.glob("outputs/*/seed_0/checkpoints/*.ckpt"))


def _workers(folder: Path) -> list[str]:
    """Processes of other ranks that were started in a folder."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if b"apex_lab.training.worker" in (path / "cmdline").read_bytes() and os.readlink(path / "cwd") == str(
                folder
            ):
                found.append(path.name)
        except OSError:
            continue
    return found


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("model=space", "clips.batch_size=4"), "but this model normalises over the batch"),
        (("model=gswm", "clips.batch_size=2"), "but this model normalises over the batch"),
        (
            ("model=apex", "trainer.validation_videos=1"),
            "1 validation videos (data.val, trainer.valid",
        ),
    ],
)
def test_what_two_processes_cannot_do_is_refused(
    words: tuple[str, ...], sentence: str, command: Callable[..., Ended]
) -> None:
    ended = command("train", "data=sprites", "scale=smoke", "trainer.devices=2", *words)
    assert ended.code == 2
    assert sentence in ended.err
    assert len(ended.err.splitlines()) == 1


def test_a_launcher_says_which_rank_this_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert given() is None
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setenv("WORLD_SIZE", "4")
    assert given() == Ranks(0, 4)
    with started({"step": 3}, devices=2, nodes=2, folder=tmp_path) as mine:
        assert mine == Ranks(0, 4)
        [file] = tmp_path.glob(".job_*.pt")
        assert torch.load(file, weights_only=True) == {"step": 3}
    assert not list(tmp_path.glob(".job_*.pt"))


def test_a_launcher_must_have_started_as_many_as_are_asked_for() -> None:
    check_given(None, devices=2, nodes=2)
    check_given(Ranks(3, 4), devices=2, nodes=2)
    for world, devices, nodes in ((2, 1, 1), (1, 2, 1), (4, 4, 2)):
        with pytest.raises(UserError, match=rf"{world} processes .*num_nodes = {nodes} ask for {devices * nodes}:"):
            check_given(Ranks(0, world), devices, nodes)


def test_several_nodes_need_a_launcher(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"trainer\.num_nodes = 2 needs a launcher"), started({}, 1, 2, tmp_path):
        pass
