"""What happens beside training: checkpoints and the display of progress."""

from __future__ import annotations

import math
import time
from typing import Annotated, Any, Literal

import lightning as L
from pydantic import Field

from apex_lab.base import console
from apex_lab.base.interrupts import Deferred
from apex_lab.base.progress import Meter
from apex_lab.runs import checkpoints
from apex_lab.runs.folder import Run
from apex_lab.training.learner import Learner


class Checkpoints(L.Callback):
    """Keeps last.ckpt (to go on from), the one before it, and best.ckpt (highest or lowest validation score).

    A step at which validation is due is stored after validation, so that going on from it repeats or misses none.

    Args:
        run: whose folder the files lie in.
        interval: steps between two checkpoints; what a kill can cost.
        validation_interval: steps between validations; None for none.
        max_steps: the last step, always stored.
        monitor: name of the validation score.
        mode: which end of it is best.
        deferred: a request to stop, acted on when the step at hand is stored.
        training: `training` entry of the checkpoint that this run goes on from.
    """

    def __init__(
        self,
        run: Run,
        interval: int,
        validation_interval: int | None,
        max_steps: int,
        monitor: str,
        mode: Literal["max", "min"],
        deferred: Deferred,
        training: dict[str, Any] | None = None,
    ) -> None:
        self._run = run
        self._interval = interval
        self._validation_interval = validation_interval
        self._max_steps = max_steps
        self._monitor = monitor
        self._sign = 1.0 if mode == "max" else -1.0
        self._deferred = deferred
        self._best: float | None = training["best"] if training else None
        self._seconds_before: float = training["seconds"] if training else 0.0
        self._start = time.monotonic()

    def on_train_start(self, trainer: L.Trainer, learner: L.LightningModule) -> None:
        self._start = time.monotonic()

    def on_train_batch_end(self, trainer: L.Trainer, learner: L.LightningModule, *_: Any) -> None:
        assert isinstance(learner, Learner)
        asked = self._deferred.signum is not None
        if (asked or learner.step % self._interval == 0) and not self._validation_due(learner.step):
            self._save_last(learner)
            self._deferred.act()

    def on_validation_end(self, trainer: L.Trainer, learner: L.LightningModule) -> None:
        assert isinstance(learner, Learner)
        score = trainer.callback_metrics.get(self._monitor)
        value = math.nan if score is None else float(score)
        if math.isfinite(value) and (self._best is None or self._sign * value > self._sign * self._best):
            self._best = value
            checkpoints.save(self._run.best, {**self._content(learner), "training": None})
        share = trainer.callback_metrics.get("val/foreground_share")
        self._run.update(foreground_share=None if share is None else float(share))
        self._save_last(learner)
        self._deferred.act()

    def on_train_end(self, trainer: L.Trainer, learner: L.LightningModule) -> None:
        assert isinstance(learner, Learner)
        if not self._validation_due(learner.step):
            self._save_last(learner)

    def _validation_due(self, step: int) -> bool:
        interval = self._validation_interval
        return interval is not None and (step % interval == 0 or step == self._max_steps)

    def _content(self, learner: Learner) -> dict[str, Any]:
        job = self._run.job
        return {
            "step": learner.step,
            "weights": {name: value.detach().cpu() for name, value in learner.model.state_dict().items()},
            "config": job.raw,
            "choices": job.choices,
        }

    def _save_last(self, learner: Learner) -> None:
        learner.fetch()  # weights that are not finite are never stored
        optimizer = learner.optimizers()
        assert not isinstance(optimizer, list)
        seconds = self._seconds_before + time.monotonic() - self._start
        training = {
            "optimizer": optimizer.state_dict(),
            "best": self._best,
            "seconds": seconds,
            "data_fingerprint": self._run.record["data_fingerprint"],
        }
        checkpoints.save(self._run.last, {**self._content(learner), "training": training}, keep_previous=True)
        self._run.update(steps=learner.step, seconds=round(seconds, 1))


class Progress(L.Callback):
    """Shows how far training is, the loss, and the last validation scores.

    Args:
        seconds: between two lines where there is no terminal.
    """

    def __init__(self, seconds: Annotated[float, Field(gt=0)] = 15.0) -> None:
        self._seconds = seconds
        self._meter: Meter | None = None
        self._first_step = 0

    def on_train_start(self, trainer: L.Trainer, learner: L.LightningModule) -> None:
        assert isinstance(learner, Learner)
        self._first_step = learner.step
        self._meter = Meter("step", learner.step + trainer.max_steps, learner.step, self._seconds)
        self._meter.__enter__()

    def on_train_batch_end(self, trainer: L.Trainer, learner: L.LightningModule, *_: Any) -> None:
        assert isinstance(learner, Learner)
        assert self._meter is not None
        if learner.step == self._first_step + 1:
            self._meter.restart(learner.step)  # the first step also pays for what is set up once
        elif self._meter.due():
            self._meter.show(learner.step, f"loss {learner.logged_loss:.1f}")

    def on_validation_end(self, trainer: L.Trainer, learner: L.LightningModule) -> None:
        assert isinstance(learner, Learner)
        names = {"val/ari_fg": "ARI-FG", "val/msc_fg": "MSC-FG", "val/ari": "ARI", "val/msc": "MSC"}
        metrics = trainer.callback_metrics
        scores = ", ".join(f"{short} {float(metrics[name]):.3f}" for name, short in names.items() if name in metrics)
        console.say(f"step {learner.step}, validation: {scores}")

    def teardown(self, trainer: L.Trainer, learner: L.LightningModule, stage: str) -> None:
        if self._meter is not None:
            self._meter.__exit__(None, None, None)
            self._meter = None
