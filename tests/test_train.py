"""Runs from their first to their last word: finished, failed, stopped, killed, gone on with."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from filelock import FileLock

from apex_lab.data.loading import GRACE
from apex_lab.runs import checkpoints
from apex_lab.train import main
from tests.conftest import TINY, Ended, wait_for_step

LONG = ("trainer.max_steps=60", "trainer.checkpoint_interval=7", "trainer.validation_interval=20")
"""Enough steps to be killed among."""


def record(run: Path) -> dict[str, Any]:
    return json.loads((run / "run.json").read_text())


def curves(run: Path) -> list[dict[str, str]]:
    with open(run / "curves.csv", newline="") as file:
        return list(csv.DictReader(file))


def without_speed(run: Path) -> list[dict[str, str]]:
    return [{k: v for k, v in row.items() if k != "train/frames_per_second"} for row in curves(run)]


def weights(run: Path) -> dict[str, torch.Tensor]:
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["inference"]["weights"]


def start(folder: Path, *words: str, code: str = "from apex_lab.train import main; main()") -> subprocess.Popen[str]:
    """Trains the tiny model in a process of its own, which can be killed."""
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "TINY_PAUSE": "0.2",
    }
    return subprocess.Popen(
        [sys.executable, "-c", code, *TINY, *words],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_an_error_ends_the_command_at_once_though_loaders_outlive_a_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    process = start(tmp_path, "++data.workers=2", "logger=wandb", *LONG)
    pictures = wait_for_step(tmp_path, 3) / "wandb" / "last_picture.val%2Fpictures.20.png"
    (pictures / "in the way").mkdir(parents=True)
    _, err = process.communicate(timeout=45)  # a loading process may live for longer
    assert process.returncode == 1
    assert f"{pictures.name} cannot be written" in err
    assert GRACE > 45


def test_a_run_leaves_everything_and_says_so(train: Callable[..., Ended], the_run: Callable[..., Path]) -> None:
    ended = train("evaluation.pictures=2")
    run = the_run()
    assert ended.code == 0
    assert run.parent.name.startswith("tiny_squares_smoke_")
    about = record(run)
    assert about["status"] == "finished"
    assert (about["model"], about["ablation"], about["data"], about["scale"]) == ("tiny", None, "squares", "smoke")
    assert (about["seed"], about["steps"]) == (0, 6)
    assert about["command"].startswith("python -m apex_lab.train --config-dir")
    assert about["versions"]["torch"] == torch.__version__
    assert about["hardware"]["device"] in ("cpu", "cuda")
    assert 0 <= about["foreground_share"] <= 1
    assert about["foreground_share"] == float(curves(run)[-1]["val/foreground_share"])
    names = ("config.yaml", "metrics.json", "objects_test.csv", "curves.csv", "log.txt", "checkpoints/last.ckpt")
    for name in (*names, "checkpoints/best.ckpt", "view/film_strip.png", "view/movie.mp4", "view/movie.gif"):
        assert (run / name).stat().st_size > 0, name
    total = json.loads((run / "metrics.json").read_text())["splits"]["test"]["total"]
    lines = ended.out.splitlines()
    heading = next(i for i, line in enumerate(lines) if line.split() == ["ARI-FG", "MSC-FG", "ARI", "MSC"])
    row = [float(number) for number in lines[heading + 1].split()]
    assert row == [round(total[key], 3) for key in ("ari_fg", "msc_fg", "ari", "msc")]
    assert lines[heading + 2].split() == ["MOTA", "MOTP", "Match", "ID", "S.", "FPs", "Miss", "MD", "MT"]
    paths = lines[heading + 4 :]
    assert paths[0].endswith("film_strip.png")
    assert all((run.parents[2] / path).is_file() for path in paths)
    assert [row["step"] for row in curves(run)] == ["1", "2", "3", "4", "5", "6"]


def test_a_finished_run_does_no_work_again(train: Callable[..., Ended], the_run: Callable[..., Path]) -> None:
    first = train()
    run = the_run()
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.name != ".lock"}
    again = train("trainer.log_interval=2", "trainer=cpu")
    assert again.code == 0
    assert again.out.splitlines()[0] == f"finished already: {run.relative_to(run.parents[2])}"
    assert again.out.splitlines()[-3:] == first.out.splitlines()[-3:]
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.name != ".lock"} == before


def test_another_configuration_is_another_run(train: Callable[..., Ended], tmp_path: Path) -> None:
    for words in ([], ["optimizer.lr=0.02"], ["seed=1"], ["+experiment=overfit"]):
        assert train(*words).code == 0
    runs = sorted(path.relative_to(tmp_path).parts for path in tmp_path.glob("outputs/*/seed_*"))
    assert len(runs) == 4
    assert len({group for _, group, _ in runs}) == 3


def test_four_seeds_make_four_runs_and_a_second_start_none(train: Callable[..., Ended], tmp_path: Path) -> None:
    words = ("seed=0,1,2,3", "-m")
    assert train(*words).code == 0
    runs = list(tmp_path.glob("outputs/*/seed_*"))
    assert [record(run)["status"] for run in runs] == ["finished"] * 4
    assert len({run.parent for run in runs}) == 1
    again = train(*words)
    assert again.code == 0
    assert again.out.splitlines() == ["4 finished before, 0 of 4 jobs to run.", "4 jobs: 4 finished."]


def test_one_failing_job_does_not_stop_the_others(train: Callable[..., Ended], tmp_path: Path) -> None:
    # a weight this large makes the loss overflow
    ended = train("loss.error=1.0,1e38,2.0", "-m")
    assert ended.code == 1
    status = sorted(record(run)["status"] for run in tmp_path.glob("outputs/*/seed_0"))
    assert status == ["failed", "finished", "finished"]
    failed = next(run for run in tmp_path.glob("outputs/*/seed_0") if record(run)["status"] == "failed")
    assert "train/loss is inf at step 1 (not finite:" in record(failed)["reason"]
    assert not (failed / "checkpoints" / "last.ckpt").exists()
    assert ended.err.splitlines()[-2] == "1 of 3 failed:"
    assert failed.parent.name in ended.err.splitlines()[-1]


def test_an_unexpected_error_is_recorded(
    train: Callable[..., Ended], the_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TINY_BROKEN_AT", "3")
    ended = train()
    assert ended.code == 1
    [line] = ended.err.splitlines()
    found = re.fullmatch(r"RuntimeError: the data broke at step 3 \(traceback: (.+)\)\.", line)
    assert found is not None, line
    assert "Traceback" in Path(found.group(1)).read_text()
    assert record(the_run())["status"] == "failed"
    assert record(the_run())["reason"] == "RuntimeError: the data broke at step 3"
    assert "the data broke" in (the_run() / "log.txt").read_text()


def test_two_processes_cannot_have_the_same_run(train: Callable[..., Ended], trained: Path) -> None:
    with FileLock(str(trained / ".lock")):
        ended = train()
    assert ended.code == 1
    assert "is being worked on by another process: wait for it or stop it." in ended.err


def test_the_same_seed_gives_the_same_curves(train: Callable[..., Ended], tmp_path: Path) -> None:
    train()
    train(f"paths.outputs={tmp_path / 'again'}")
    first, second = next(tmp_path.glob("outputs/*/seed_0")), next(tmp_path.glob("again/*/seed_0"))
    assert without_speed(first) == without_speed(second)


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A longer run that nothing has stopped."""
    folder = tmp_path_factory.mktemp("unbroken")
    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(folder)
        patched.setattr(sys, "argv", ["train", *TINY, *LONG])
        main()
    return next(folder.glob("outputs/*/seed_0"))


def equal(run: Path, other: Path) -> None:
    """Two runs ended with the same weights, scores and curves."""
    ours, theirs = weights(run), weights(other)
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    best, other_best = (checkpoints.load(path / "checkpoints" / "best.ckpt", trusted=True) for path in (run, other))
    assert best["step"] == other_best["step"]
    scores = [json.loads((path / "metrics.json").read_text())["splits"] for path in (run, other)]
    for split in (*scores[0].values(), *scores[1].values()):
        split["data"].pop("folder", None)  # equal data may lie in two places
    assert scores[0] == scores[1]
    assert without_speed(run) == without_speed(other)


def test_killed_in_training_the_same_command_ends_as_unbroken(
    train: Callable[..., Ended], unbroken: Path, tmp_path: Path
) -> None:
    process = start(tmp_path, *LONG)
    run = wait_for_step(tmp_path, 25)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert record(run)["status"] == "running"
    ended = train(*LONG)
    assert ended.code == 0
    assert "resuming from step" in ended.out
    assert record(run)["status"] == "finished"
    equal(run, unbroken)


KILLED_WRITING = """
import os, signal
from apex_lab.base import files
calls, place = 0, os.{function}
def killing(*arguments):
    global calls
    calls += 'ckpt' in str(arguments) or '{function}' == 'fsync'
    if calls == {call}:
        os.kill(os.getpid(), signal.SIGKILL)
    return place(*arguments)
os.{function} = killing
from apex_lab.train import main
main()
"""


@pytest.mark.slow  # a kill elsewhere: above; a checkpoint that is not whole: below; files: tests/base/test_files.py
@pytest.mark.parametrize(("function", "call"), [("fsync", 40), ("replace", 9), ("replace", 10)])
def test_killed_while_writing_a_checkpoint(
    function: str, call: int, train: Callable[..., Ended], unbroken: Path, tmp_path: Path
) -> None:
    process = start(tmp_path, *LONG, code=KILLED_WRITING.format(function=function, call=call))
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    run = next(tmp_path.glob("outputs/*/seed_0"))
    assert record(run)["status"] == "running"
    assert train(*LONG).code == 0
    equal(run, unbroken)
    assert list(run.rglob("*.part")) == []


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
@pytest.mark.slow  # in the test's own process: tests/test_stops.py
def test_asked_to_stop_it_stores_the_step_at_hand(
    number: signal.Signals, code: int, train: Callable[..., Ended], unbroken: Path, tmp_path: Path
) -> None:
    rare = (*LONG, "trainer.checkpoint_interval=10000")
    process = start(tmp_path, *rare)
    run = wait_for_step(tmp_path, 20)
    time.sleep(0.2)
    process.send_signal(number)
    _, err = process.communicate()
    assert process.returncode == code
    assert f"Stopped by {number.name}; the same command resumes from here." in err
    assert record(run)["status"] == "failed"
    assert record(run)["reason"] == f"stopped by {number.name}"
    assert checkpoints.load(run / "checkpoints" / "last.ckpt", trusted=True)["step"] == record(run)["steps"] > 20
    assert train(*rare).code == 0
    equal(run, unbroken)


def test_a_damaged_last_checkpoint_is_told_and_the_one_before_taken(
    train: Callable[..., Ended], the_run: Callable[..., Path], unbroken: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TINY_BROKEN_AT", "30")
    assert train(*LONG).code == 1
    run = the_run()
    last = run / "checkpoints" / "last.ckpt"
    last.write_bytes(last.read_bytes()[:-200])
    monkeypatch.delenv("TINY_BROKEN_AT")
    ended = train(*LONG)
    assert ended.code == 0
    assert f"{last.relative_to(run.parents[2])} is no checkpoint, or its end is missing" in ended.err
    assert "resuming from step 21" in ended.out
    equal(run, unbroken)


def test_without_a_whole_checkpoint_nothing_is_started_anew(
    train: Callable[..., Ended], the_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TINY_BROKEN_AT", "5")
    assert train().code == 1
    for path in (the_run() / "checkpoints").glob("*.ckpt"):
        path.write_bytes(b"")
    ended = train()
    assert ended.code == 1
    assert f"No whole checkpoint is left in {the_run().relative_to(the_run().parents[2])}/checkpoints" in ended.err


def test_other_data_are_refused_on_going_on(
    train: Callable[..., Ended], the_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TINY_BROKEN_AT", "5")
    assert train().code == 1
    about = record(the_run())
    (the_run() / "run.json").write_text(json.dumps({**about, "data_fingerprint": "0" * 64}))
    ended = train()
    assert ended.code == 1
    assert "was started with other data (fingerprint 00000000, now" in ended.err


def test_weights_of_other_code_are_refused_on_going_on(
    train: Callable[..., Ended], the_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TINY_BROKEN_AT", "5")
    assert train().code == 1
    last = the_run() / "checkpoints" / "last.ckpt"
    content = torch.load(last, weights_only=True)
    content["inference"]["weights"]["masks.9.bias"] = content["inference"]["weights"].pop("masks.2.bias")
    torch.save(content, last)
    ended = train()
    assert ended.code == 1
    assert "was made by other code (" in ended.err
    assert len(ended.err.splitlines()) == 1


def test_a_checkpoint_of_another_configuration_is_refused(
    train: Callable[..., Ended], the_run: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TINY_BROKEN_AT", "5")
    assert train().code == 1
    base = the_run()
    assert train("loss.spread=0.7").code == 1
    [other] = (path for path in (tmp_path / "outputs").glob("*/seed_0") if path != base)
    shutil.copy(base / "checkpoints" / "last.ckpt", other / "checkpoints" / "last.ckpt")
    ended = train("loss.spread=0.7")
    assert ended.code == 1
    assert "was made with another configuration (scale=smoke model=tiny data=squares)" in ended.err
    assert len(ended.err.splitlines()) == 1


def test_a_run_that_lost_its_curves_is_evaluated_without_their_page(train: Callable[..., Ended], trained: Path) -> None:
    for name in ("curves.csv", "metrics.json"):
        (trained / name).unlink()
    ended = train("evaluation.pictures=1")
    assert ended.code == 0, ended.err
    assert (trained / "metrics.json").is_file()
    assert not list(trained.rglob("curves.png"))


def test_a_full_disk_is_told_and_the_checkpoint_before_stays(
    train: Callable[..., Ended], the_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = torch.save

    def full(content: dict[str, Any], file: Any) -> None:
        if content["step"] > 2:
            raise OSError(28, "No space left on device")
        real(content, file)

    with monkeypatch.context() as patched:
        patched.setattr(torch, "save", full)
        ended = train()
    assert ended.code == 1
    assert "No space left for" in ended.err
    assert len(ended.err.splitlines()) == 1
    assert record(the_run())["status"] == "failed"
    assert checkpoints.load(the_run() / "checkpoints" / "last.ckpt", trusted=True)["step"] == 2
    assert train().code == 0


def test_long_training_on_a_cpu_is_announced(
    train: Callable[..., Ended], monkeypatch: pytest.MonkeyPatch, the_run: Callable[..., Path]
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr("apex_lab.training.estimate.SMALL", 0.0)
    monkeypatch.setattr("apex_lab.training.estimate.LONG", 0.0)
    ended = train()
    assert ended.code == 0
    assert "Training will take about" in ended.err
    assert "python -m apex_lab.train scale=cpu" in ended.err


def test_a_model_that_does_not_train_is_evaluated(command: Callable[..., Ended], the_run: Callable[..., Path]) -> None:
    ended = command("train", *TINY, "model=one_segment")
    assert ended.code == 0
    assert record(the_run())["status"] == "finished"
    assert (the_run() / "checkpoints" / "last.ckpt").is_file()
    assert not (the_run() / "curves.csv").exists()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a compiler")
def test_a_compiled_run_has_the_same_checkpoint_layout(train: Callable[..., Ended], tmp_path: Path) -> None:
    # The numbers differ: compiled code draws its noise from a generator of its own. It runs in a process of its own,
    # because the type checks of the tests cannot be compiled (pytorch #122093).
    process = start(tmp_path, "trainer.compile=true", "paths.outputs=compiled")
    _, said = process.communicate()
    assert process.returncode == 0, said
    assert train().code == 0
    plain, compiled = (weights(next(tmp_path.glob(f"{name}/*/seed_0"))) for name in ("outputs", "compiled"))
    assert plain.keys() == compiled.keys()
    assert all(value.isfinite().all() for value in compiled.values())


@pytest.mark.slow
def test_apex_on_p2d_killed_in_simulation_and_in_training_ends_as_unbroken(
    command: Callable[..., Ended], tmp_path: Path
) -> None:
    words = ("scale=smoke", "trainer.max_steps=30", "trainer.checkpoint_interval=4", "evaluation.pictures=0")
    assert command("train", *words, "paths.outputs=unbroken", "paths.data=other").code == 0

    def begin() -> subprocess.Popen[bytes]:
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        program = (sys.executable, "-m", "apex_lab.train", *words)
        return subprocess.Popen(program, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL)

    simulating = begin()
    while not list(tmp_path.glob("data/p2d_*/train/*")):
        time.sleep(0.02)
        assert simulating.poll() is None
    simulating.kill()
    simulating.wait()
    assert not list(tmp_path.glob("data/p2d_*/manifest.json"))
    training = begin()
    run = wait_for_step(tmp_path, 8)
    training.kill()
    training.wait()
    assert record(run)["steps"] < 30
    assert command("train", *words).code == 0
    equal(run, next(tmp_path.glob("unbroken/*/seed_0")))
    ours, theirs = (
        {path.relative_to(data): path.read_bytes() for path in data.rglob("*.np[yz]") if path.name[0] != "."}
        for data in (next(tmp_path.glob("data/p2d_*")), next(tmp_path.glob("other/p2d_*")))
    )
    assert ours == theirs
    assert ours
