"""`trainer.max_steps` raised: a finished run goes on in a folder of its own, as a run of that length would have."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.conftest import Ended
from tests.test_train import curves, record, weights, without_speed

FALLING = "lr_scale={_target_: apex_lab.training.schedules.Linear, start: 1.0, end: 0.0, steps: '${trainer.max_steps}'}"
"""A schedule that depends on the length of training."""


def runs(folder: Path) -> dict[int, Path]:
    """`trainer.max_steps` -> run folder."""
    return {record(run)["max_steps"]: run for run in sorted(folder.glob("*/seed_0"))}


def content(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def checkpoint(run: Path, name: str = "last") -> dict[str, Any]:
    return torch.load(run / "checkpoints" / f"{name}.ckpt", weights_only=True)


def equal(one: Any, other: Any) -> bool:
    """Whether two nested values are the same, tensors bit for bit."""
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(value, other[key]) for key, value in one.items())
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(equal, one, other))
    return bool(one == other)


def scores(run: Path) -> Any:
    return json.loads((run / "metrics.json").read_text())["splits"]["test"]["per_video"]


def check_as_unbroken(run: Path, unbroken: Path) -> None:
    assert run.parent.name == unbroken.parent.name
    ours, theirs = checkpoint(run), checkpoint(unbroken)
    for each in (ours, theirs):
        each["training"].pop("seconds")
        each["training"].pop("record")
        each["config"].pop("paths")
    assert equal(ours, theirs)
    assert without_speed(run) == without_speed(unbroken)
    assert scores(run) == scores(unbroken)
    assert record(run)["foreground_share"] == record(unbroken)["foreground_share"]


# 4: the validation at the end of the shorter run is none of the longer one's
@pytest.mark.parametrize("interval", [pytest.param(3, marks=pytest.mark.slow), 4])
def test_a_longer_run_is_as_if_it_had_begun_so(interval: int, train: Callable[..., Ended], tmp_path: Path) -> None:
    words = (f"trainer.validation_interval={interval}", "trainer.checkpoint_interval=5")
    assert train(*words).code == 0
    shorter = runs(tmp_path / "outputs")[6]
    before = content(shorter)
    ended = train(*words, "trainer.max_steps=11")
    assert ended.code == 0, ended.err
    assert f"going on from step 6 of {shorter.relative_to(tmp_path)}, which stays as it is" in ended.out
    assert "resuming from step 6" in ended.out
    assert train(*words, "trainer.max_steps=11", "paths.outputs=unbroken").code == 0
    run, unbroken = runs(tmp_path / "outputs")[11], runs(tmp_path / "unbroken")[11]
    check_as_unbroken(run, unbroken)
    best, other = checkpoint(run, "best"), checkpoint(unbroken, "best")
    best["config"].pop("paths")
    other["config"].pop("paths")
    assert equal(best, other)
    assert record(run)["continues"] == {"folder": str(shorter.relative_to(tmp_path)), "step": 6}
    assert record(run)["seconds"] >= record(shorter)["seconds"]
    assert content(shorter) == before
    assert train(*words, "trainer.max_steps=11").out.startswith("finished already")
    assert train(*words).out.startswith("finished already")


@pytest.mark.slow
def test_it_goes_on_again_after_a_stop_without_the_shorter_run(
    train: Callable[..., Ended], trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("trainer.max_steps=12", "trainer.checkpoint_interval=5")
    monkeypatch.setenv("TINY_BROKEN_AT", "1")  # of those that are left
    assert train(*words).code == 1
    monkeypatch.delenv("TINY_BROKEN_AT")
    trained.rename(tmp_path / "away")
    ended = train(*words)
    assert ended.code == 0, ended.err
    assert "resuming from step 6" in ended.out
    assert train(*words, "paths.outputs=unbroken").code == 0
    check_as_unbroken(runs(tmp_path / "outputs")[12], runs(tmp_path / "unbroken")[12])


def test_schedules_that_depend_on_the_length_are_told(train: Callable[..., Ended], tmp_path: Path) -> None:
    assert train(FALLING).code == 0
    ended = train(FALLING, "trainer.max_steps=12")
    assert ended.code == 0, ended.err
    [line] = [line for line in ended.out.splitlines() if "gone on with" in line]
    shorter = runs(tmp_path / "outputs")[6].relative_to(tmp_path)
    assert line == (
        f"{shorter}, the same run with 6 steps, is not gone on with: lr_scale was 0.8333333333333334 at step 1 and is "
        "0.9166666666666666 with trainer.max_steps = 12. Training starts from the beginning."
    )
    assert curves(runs(tmp_path / "outputs")[12])[0]["step"] == "1"
    assert "resuming" not in ended.out
    assert "continues" not in record(runs(tmp_path / "outputs")[12])


@pytest.mark.slow
def test_schedules_that_differ_later_alone_are_gone_on_with(train: Callable[..., Ended], tmp_path: Path) -> None:
    def falling(steps: int) -> str:
        knots = "_target_: apex_lab.training.schedules.Piecewise, steps: [0, 6, 8]"
        return f"lr_scale={{{knots}, values: [1.0, 0.5, {1 / steps}]}}"

    assert train(falling(6)).code == 0
    longer = (falling(12), "trainer.max_steps=12")
    ended = train(*longer)
    assert "going on from step 6" in ended.out
    assert train(*longer, "paths.outputs=unbroken").code == 0
    check_as_unbroken(runs(tmp_path / "outputs")[12], runs(tmp_path / "unbroken")[12])


@pytest.mark.slow
def test_a_run_that_an_early_stop_may_have_ended_is_not_gone_on_with(train: Callable[..., Ended]) -> None:
    words = ("+callbacks.early._target_=lightning.pytorch.callbacks.EarlyStopping", "+callbacks.early.monitor=val/loss")
    assert train(*words).code == 0
    ended = train(*words, "trainer.max_steps=9")
    assert ended.code == 0, ended.err
    assert "callbacks with a state of their own (EarlyStopping) may have ended the longer run at that step" in ended.out


@pytest.mark.slow
def test_a_shorter_run_that_cannot_be_used_is_told(train: Callable[..., Ended], trained: Path, tmp_path: Path) -> None:
    last = trained / "checkpoints" / "last.ckpt"
    whole = last.read_bytes()
    changed = checkpoint(trained)
    changed["training"]["data_fingerprint"] = "other"
    torch.save(changed, last)
    ended = train("trainer.max_steps=7")
    assert ended.code == 0, ended.err
    assert "is not gone on with: it was trained on other data.\nTraining starts from the beginning.\n" in ended.out
    # of several the longest that is whole
    last.write_bytes(whole)
    (seven,) = (run for steps, run in runs(tmp_path / "outputs").items() if steps == 7)
    damaged = seven / "checkpoints" / "last.ckpt"
    damaged.write_bytes(damaged.read_bytes()[:-100])
    ended = train("trainer.max_steps=8")
    assert ended.code == 0, ended.err
    assert f"{seven.relative_to(tmp_path)}, the same run with 7 steps, is not gone on with: " in ended.out
    assert "its end is missing" in ended.out
    assert f"going on from step 6 of {trained.relative_to(tmp_path)}" in ended.out
    assert "from the beginning" not in ended.out


@pytest.mark.slow
def test_runs_that_are_not_finished_or_differ_otherwise_are_passed_over(
    train: Callable[..., Ended], trained: Path
) -> None:
    about = record(trained)
    ended = train("trainer.max_steps=7", "optimizer.lr=0.02")
    assert "gone on" not in ended.out
    assert "going on" not in ended.out
    (trained / "run.json").write_text(json.dumps({**about, "status": "failed"}))
    ended = train("trainer.max_steps=7")
    assert "going on" not in ended.out
    assert [row["step"] for row in curves(trained)] == ["1", "2", "3", "4", "5", "6"]
    assert weights(trained)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["apex", "gswm", "op3", "scalor", "slot_attention", "space"])
def test_every_learned_model(model: str, command: Callable[..., Ended], tmp_path: Path) -> None:
    words = (f"model={model}", "data=sprites", "scale=smoke", "evaluation.pictures=0", "trainer=cpu")
    assert command("train", *words).code == 0
    ended = command("train", *words, "trainer.max_steps=9")
    assert ended.code == 0, ended.err
    assert "going on from step 6" in ended.out
    assert command("train", *words, "trainer.max_steps=9", "paths.outputs=unbroken").code == 0
    check_as_unbroken(runs(tmp_path / "outputs")[9], runs(tmp_path / "unbroken")[9])
