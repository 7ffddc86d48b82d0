"""A loss that is not finite: training stops at that step, names the term, keeps the batch and the checkpoint before."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from apex_lab.data import training_loader
from apex_lab.runs import checkpoints
from apex_lab.training.update import WeightUpdate
from apex_lab.training.watch import Watch
from tests.conftest import Ended
from tests.kills.works import MODELS, SQUARES
from tests.test_train import record
from tests.tiny import SquaresSource

WORDS = (
    *("trainer.max_steps=8", "trainer.checkpoint_interval=3", "trainer.validation_interval=8"),
    *("trainer.log_interval=100", "data.train=6", "clips.batch_size=2", "clips.frames=null"),
)


@pytest.fixture
def broken_at_5(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Makes the first loss term NaN in the fifth update; its name, once it has happened."""
    real, names = WeightUpdate.objective, []

    def objective(self: WeightUpdate, terms: dict[str, Tensor]) -> Tensor:
        if self.step == 4 and self.model.training:
            names[:] = [next(name for name, weight in self.weights.schedules.items() if weight(4) != 0)]
            terms[names[0]] = terms[names[0]] * torch.nan
        return real(self, terms)

    monkeypatch.setattr(WeightUpdate, "objective", objective)
    return names


@pytest.mark.parametrize("model", ["tiny", *(pytest.param(model, marks=pytest.mark.slow) for model in MODELS)])
def test_training_stops_at_the_step_with_term_and_batch(
    model: str,
    broken_at_5: list[str],
    command: Callable[..., Ended],
    the_run: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    words = (*SQUARES, f"model={model}", *WORDS)
    ended = command("train", *words)
    assert ended.code == 1
    run = the_run()
    [line] = ended.err.splitlines()
    [term] = broken_at_5
    assert line.startswith("train/loss is nan at step 5 (not finite: train/loss, ")
    assert f", train/{term}, " in line
    assert f"its batch is kept in {run.relative_to(run.parents[2])}/diverged.npz" in line
    assert (record(run)["status"], record(run)["outcome"], record(run)["steps"]) == ("failed", "diverged", 3)
    assert checkpoints.load(run / "checkpoints" / "last.ckpt", trusted=True)["step"] == 3
    data = SquaresSource(train=6)
    batch = list(training_loader(data, 2, 0, 0, 8))[4]
    with np.load(run / "diverged.npz", allow_pickle=False) as kept:
        assert np.array_equal(kept["video"], batch["video"].numpy())
        assert kept["name"].tolist() == list(batch["name"])
        assert (int(kept["step"]), json.loads(str(kept["values"]))[f"train/{term}"]) == (5, "nan")
    monkeypatch.undo()


def test_weights_that_are_not_finite_are_not_stored(
    command: Callable[..., Ended], the_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = WeightUpdate.forward

    def forward(self: WeightUpdate, *words: Any, **named: Any) -> None:
        real(self, *words, **named)
        if self.step == 3:
            next(self.model.parameters()).data.fill_(torch.inf)

    monkeypatch.setattr(WeightUpdate, "forward", forward)
    ended = command("train", *SQUARES, "model=tiny", *WORDS, "trainer.checkpoint_interval=1")
    assert ended.code == 1
    assert ended.err.startswith("Weights are not finite after step 3 (not finite: masks.0.weight): ")
    assert checkpoints.load(the_run() / "checkpoints" / "last.ckpt", trusted=True)["step"] == 2
    assert record(the_run())["outcome"] == "diverged"


def test_a_look_that_lags_finds_the_first_update_that_was_not_finite() -> None:
    def latest(loss: float) -> Mapping[str, Tensor]:
        return {"train/loss": torch.tensor(loss), "train/gradient_norm": torch.tensor(1.0)}

    watch = Watch(["train/loss"])
    real = watch.look
    watch.look = lambda lag=0: real(max(lag, 2)) if lag == 0 else real(lag)  # type: ignore[method-assign]
    found = [watch.add(step, latest(loss), {"step": step}) for step, loss in enumerate((1.0, np.inf, 2.0, np.nan), 1)]
    assert found[:3] == [None] * 3
    assert found[3] is not None
    assert (found[3].step, found[3].batch) == (2, {"step": 2})
    last = real()
    assert last is not None
    assert last.step == 4
