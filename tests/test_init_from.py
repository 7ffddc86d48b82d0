"""`init_from`: training that starts from given weights."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from apex_lab.base.errors import UserError
from apex_lab.config import initial, shipped
from apex_lab.config.upgrades import fingerprint
from tests.conftest import Ended, compose_job
from tests.test_train import curves, record, weights

STILL = ("optimizer.lr=1e-12", "trainer.max_steps=2", "trainer.validation_interval=null")
"""Training that leaves weights where they are."""


@pytest.fixture
def source(trained: Path, tmp_path: Path) -> Path:
    """A finished run, away from `outputs`."""
    return shutil.move(trained, tmp_path / "source")


def runs(folder: Path) -> list[Path]:
    return sorted(folder.glob("outputs/*/seed_*"))


def test_weights_are_taken_over_and_the_rest_is_fresh(
    train: Callable[..., Ended], the_run: Callable[..., Path], source: Path
) -> None:
    ended = train("init_from=source", *STILL)
    assert ended.code == 0, ended.err
    before, after = weights(source), weights(the_run())
    assert all(torch.allclose(before[name], after[name], rtol=0, atol=1e-9) for name in before)
    assert [row["step"] for row in curves(the_run())] == ["1", "2"]
    state = torch.load(the_run() / "checkpoints" / "last.ckpt", weights_only=True)["training"]["optimizer"]["state"]
    assert {float(each["step"]) for each in state.values()} == {2.0}
    about = record(the_run())["init_from"]
    assert about["checkpoint"] == str(source)
    assert f"starting from the weights of {source} ({about['weights'][:8]})" in ended.out


def test_the_weights_name_the_run_and_the_path_does_not(
    train: Callable[..., Ended], tmp_path: Path, source: Path
) -> None:
    assert train("init_from=source/checkpoints/last.ckpt", *STILL).code == 0
    content = torch.load(source / "checkpoints" / "last.ckpt", weights_only=True)
    # the same weights in a file with other bytes
    torch.save({**content, "step": 3, "training": None}, tmp_path / "other.ckpt")
    assert train("init_from=other.ckpt", *STILL).out.startswith("finished already")
    assert train(f"init_from={source}", *STILL).out.startswith("finished already")
    content["inference"]["weights"]["base"] += 1e-6
    torch.save(content, tmp_path / "other.ckpt")
    assert "finished already" not in train("init_from=other.ckpt", *STILL).out
    assert "finished already" not in train(*STILL).out
    assert len(runs(tmp_path)) == 3


def test_it_goes_on_without_the_file(
    train: Callable[..., Ended], tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert train("init_from=source", "paths.outputs=unbroken").code == 0
    monkeypatch.setenv("TINY_BROKEN_AT", "4")
    assert train("init_from=source").code == 1
    monkeypatch.delenv("TINY_BROKEN_AT")
    shutil.rmtree(source)
    ended = train("init_from=source")
    assert ended.code == 0, ended.err
    assert "resuming from step 4" in ended.out
    [run], [unbroken] = runs(tmp_path), tmp_path.glob("unbroken/*/seed_0")
    assert run.parent.name == unbroken.parent.name
    ours, theirs = weights(run), weights(unbroken)
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    # a seed that has not begun does need it
    ended = train("init_from=source", "seed=1")
    assert ended.code == 1
    assert "init_from = " in ended.err
    assert "does not exist" in ended.err
    # of two versions of a file that is gone, none is meant
    other = run.parent.parent / "tiny_squares_smoke_00000000" / "seed_0"
    shutil.copytree(run, other)
    (other / "run.json").write_text(
        json.dumps({**record(run), "init_from": {"checkpoint": str(source), "weights": "0" * 64}})
    )
    ended = train("init_from=source")
    assert ended.code == 2
    assert "began with 2 versions of it: put the file back" in ended.err


def test_weights_that_do_not_fit_are_told_before_work(
    train: Callable[..., Ended], tmp_path: Path, source: Path
) -> None:
    ended = train("init_from=source", "seed=0,1", "model.width=16", "-m")
    assert ended.code == 2
    assert ended.err.splitlines() == [
        f"init_from = {source} does not fit the model: masks.0.weight is 8 x 3 x 3 x 3 there and 16 x 3 x 3 x 3 here, "
        "masks.0.bias is 8 there and 16 here, masks.2.weight is 3 x 8 x 1 x 1 there and 3 x 16 x 1 x 1 here."
    ]
    content = torch.load(source / "checkpoints" / "last.ckpt", weights_only=True)
    content["inference"]["weights"]["more"] = content["inference"]["weights"].pop("base")
    torch.save(content, tmp_path / "other.ckpt")
    ended = train("init_from=other.ckpt")
    assert ended.code == 2
    assert "does not fit the model: the file lacks base; the model has no more." in ended.err
    assert not (tmp_path / "outputs").exists() or not runs(tmp_path)


class Evil:
    def __reduce__(self) -> Any:
        return os.system, ("touch was_run",)


# format 1 holds no values of schedules, so reading all of it would build them
@pytest.mark.parametrize("format", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_file_runs_no_code(format: int, train: Callable[..., Ended], tmp_path: Path, source: Path) -> None:
    content = torch.load(source / "checkpoints" / "last.ckpt", weights_only=True)
    node = {"_target_": "os.system", "command": "touch was_run"}
    stranger = {**content, "format": format}
    stranger["config"] = {**content["config"], "model": node, "schedule": {"noise": node}}
    if format == 1:
        stranger["weights"] = stranger.pop("inference")["weights"]
    else:
        stranger["inference"] = {**content["inference"], "model": node}
    torch.save(stranger, tmp_path / "stranger.ckpt")
    ended = train("init_from=stranger.ckpt", *STILL)
    assert ended.code == 0, ended.err
    torch.save({**content, "choices": Evil()}, tmp_path / "stranger.ckpt")
    ended = train("init_from=stranger.ckpt", *STILL, "seed=1")
    assert ended.code == 1
    assert "stranger.ckpt is damaged or no checkpoint" in ended.err
    assert not (tmp_path / "was_run").exists()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["init_from=none.ckpt"], "init_from = none.ckpt does not exist: give a .ckpt file or a run folder."),
        (["init_from=apex-p2d-gpu"], "init_from = apex-p2d-gpu does not exist; did you mean 'apex-p2d-cpu'?"),
        (["init_from=3"], "init_from = 3 is wrong: give a checkpoint file, a run folder, or apex-p2d-cpu."),
        (["init_from="], "init_from = '' is wrong: it is empty, as an unset variable is: give a path."),
        (
            ["init_from=text"],
            "init_from = text is damaged or no checkpoint (BadZipFile): give a .ckpt file",
        ),
        (["init_from=source", "model=one_segment"], "init_from is for training, and this model has nothing to train"),
    ],
)
def test_what_cannot_be_started_from(
    words: list[str], sentence: str, train: Callable[..., Ended], source: Path, tmp_path: Path
) -> None:
    (tmp_path / "text").write_text("no checkpoint")
    ended = train(*words)
    assert ended.code == 2
    assert sentence in ended.err
    assert len(ended.err.splitlines()) == 1


@pytest.mark.slow
def test_weights_of_a_run_that_diverged_are_refused(train: Callable[..., Ended], tmp_path: Path, source: Path) -> None:
    content = torch.load(source / "checkpoints" / "last.ckpt", weights_only=True)
    content["inference"]["weights"]["base"] *= float("nan")
    torch.save(content, tmp_path / "sick.ckpt")
    ended = train("init_from=sick.ckpt")
    assert ended.code == 1
    assert "sick.ckpt holds weights that are not finite (base)" in ended.err


def test_shipped_weights_have_a_name() -> None:
    job = compose_job("model=apex", "data=p2d", "scale=cpu", "init_from=apex-p2d-cpu")
    assert job.config.init_from is not None
    assert job.config.init_from.checkpoint == "apex-p2d-cpu"
    copied = {**job.raw, "init_from": {**job.raw["init_from"], "checkpoint": "/elsewhere.ckpt"}}
    assert fingerprint(copied) == fingerprint(job.raw)
    assert fingerprint({**job.raw, "init_from": None}) != fingerprint(job.raw)


def test_the_digest_is_that_of_names_types_sizes_and_values(tmp_path: Path) -> None:
    made = {
        "b": torch.arange(24.0).reshape(2, 3, 2, 2).to(memory_format=torch.channels_last),
        "a": torch.arange(40).reshape(8, 5)[2:6, ::2].t(),
        "count": torch.tensor(7),
        "empty": torch.zeros(0, 3, dtype=torch.float64),
    }
    torch.save({"weights": made}, tmp_path / "a.ckpt")
    found = hashlib.sha256()
    kinds = {torch.float32: "Float", torch.int64: "Long", torch.float64: "Double"}
    for name in sorted(made):
        values = made[name].contiguous()
        found.update(f"{name} {kinds[values.dtype]}Storage {tuple(values.shape)}\n".encode() + values.numpy().tobytes())
    about = initial.stored(tmp_path / "a.ckpt")
    assert about.digest == found.hexdigest()
    assert about.sizes == {name: tuple(value.shape) for name, value in made.items()}
    assert initial.stored(shipped.weights("apex-p2d-cpu")).digest.startswith("2af91ece")


def test_a_tensor_beyond_its_storage_is_refused(tmp_path: Path) -> None:
    torch.save({"weights": {"a": torch.ones(1).expand(1 << 40)}}, tmp_path / "a.ckpt")
    with pytest.raises(UserError, match=r"a\.ckpt is damaged or no checkpoint \(ValueError\)"):
        initial.stored(tmp_path / "a.ckpt")
