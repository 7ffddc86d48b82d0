"""Callbacks of training: checkpoints, stopping, and the display of progress."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import lightning as L
import torch
import torch.distributed as dist
from pydantic import Field

from apex_lab.base import console, faults, interrupts
from apex_lab.base.errors import UserError
from apex_lab.base.progress import Meter
from apex_lab.runs import checkpoints
from apex_lab.runs.folder import Run
from apex_lab.training.learner import Diverged, Learner


class Checkpoints(L.Callback):
    """Keeps last.ckpt (to resume from), the one before it, and best.ckpt (highest or lowest validation score).

    A step at which validation is due is stored after validation, so that resuming from it repeats or misses none. It
    must be the last callback, so that it stores what the others have made of a step.

    Args:
        run: whose folder the files lie in.
        interval: steps between two checkpoints; what a kill can cost.
        validation_interval: steps between validations; None for none.
        max_steps: the last step, always stored.
        monitor: name of the validation score.
        mode: which end of it is best.
        training: `training` entry of the checkpoint that this run resumes from.
    """

    def __init__(
        self,
        run: Run,
        interval: int,
        validation_interval: int | None,
        max_steps: int,
        monitor: str,
        mode: Literal["max", "min"],
        training: Mapping[str, Any] | None = None,
    ) -> None:
        self._run = run
        self._interval = interval
        self._validation_interval = validation_interval
        self._max_steps = max_steps
        self._monitor = monitor
        self._sign = 1.0 if mode == "max" else -1.0
        self._best: float | None = training["best"] if training else None
        self._seconds_before: float = training["seconds"] if training else 0.0
        self._start = time.monotonic()
        self._stored: int | None = None

    def on_train_start(self, trainer: L.Trainer, learner: L.LightningModule) -> None:
        self._start = time.monotonic()
        self._states(trainer)  # a state that cannot be stored is told before the work, not after it

    def on_train_batch_end(self, trainer: L.Trainer, learner: L.LightningModule, *_: Any) -> None:
        assert isinstance(learner, Learner)
        stored_now = learner.stop is not None or learner.step % self._interval == 0
        if stored_now and not self._validation_due(trainer, learner.step):
            self._save_last(trainer, learner)

    def on_validation_end(self, trainer: L.Trainer, learner: L.LightningModule) -> None:
        assert isinstance(learner, Learner)
        score = trainer.callback_metrics.get(self._monitor)
        value = math.nan if score is None else float(score)
        if math.isfinite(value) and (self._best is None or self._sign * value > self._sign * self._best):
            self._best = value
            checkpoints.save(self._run.best, {**self._content(learner), "training": None})
        share = trainer.callback_metrics.get("val/foreground_share")
        self._run.update(foreground_share=None if share is None else float(share))
        self._save_last(trainer, learner)

    def on_train_end(self, trainer: L.Trainer, learner: L.LightningModule) -> None:
        assert isinstance(learner, Learner)
        if self._stored != learner.step:
            self._save_last(trainer, learner)

    def _validation_due(self, trainer: L.Trainer, step: int) -> bool:
        interval = self._validation_interval
        # Lightning validates once more where a callback ends training
        return interval is not None and (step % interval == 0 or _ended(trainer, step, self._max_steps))

    def _content(self, learner: Learner) -> dict[str, Any]:
        """What every checkpoint holds.

        Raises:
            Diverged: weights are not finite; such are never stored.
        """
        job = self._run.job
        inference = checkpoints.inference_part(job.config, learner.update.model, learner.step)
        sick = [name for name, weight in inference["weights"].items() if not torch.isfinite(weight).all()]
        if sick:  # the loss will tell at the next step, which is too late for the checkpoint
            raise Diverged(
                f"Weights are not finite after step {learner.step} (not finite: {sick[0]}): "
                "try a lower optimizer.lr, a lower trainer.gradient_clip_norm or another seed."
            )
        return {
            "step": learner.step,
            "inference": inference,
            "config": job.raw,
            "choices": job.choices,
        }

    def _save_last(self, trainer: L.Trainer, learner: Learner) -> None:
        seconds = self._seconds_before + time.monotonic() - self._start
        training = {
            "optimizer": learner.raw_optimizer().state_dict(),
            "callbacks": self._states(trainer),
            "best": self._best,
            "seconds": seconds,
            "data_fingerprint": self._run.record["data_fingerprint"],
            "ended": _ended(trainer, learner.step, self._max_steps),
            "record": self._run.kept(),
        }
        checkpoints.save(self._run.last, {**self._content(learner), "training": training}, keep_previous=True)
        self._stored = learner.step
        self._run.beat(steps=learner.step, seconds=round(seconds, 1))

    def _states(self, trainer: L.Trainer) -> dict[str, Any]:
        """The other callbacks' states, by Lightning's name for each.

        Raises:
            UserError: a state that a checkpoint cannot hold.
        """
        states = {}
        for callback in _others(trainer, self):
            state = callback.state_dict()
            if state and not checkpoints.holds(state):
                raise UserError(
                    f"The state of {callback.state_key} cannot be stored: let its state_dict() give plain values and "
                    "tensors alone, which a checkpoint can hold without running code."
                )
            if state:
                states[callback.state_key] = state
        return states


def not_restored(what: str, error: Exception) -> str:
    """The sentence for a part of a checkpoint that does not fit what it is for."""
    return (
        f"The run's checkpoint does not fit its configuration ({what}: {faults.cited(error)}): "
        "go back to the code that made it, or remove the run's folder to start again."
    )


class Lockstep(L.Callback):
    """What every rank does alike: takes back callbacks' states, agrees on the step to stop at, looks at what is stored.

    A request to stop that reaches any rank, and rank 0's clock, stop all ranks after the same step, and after the
    validation that is due there. Before rank 0 stores a step, all ranks look whether every update up to it is finite:
    they exchange what they saw, so rank 0 must not look alone. It stands behind the callbacks whose states it gives
    back, and before `Checkpoints`.

    Args:
        states: of callbacks, by Lightning's name for each.
        interval: steps between two checkpoints.
        max_steps: the last step; no time is up there.
        deadline: when time is up, by `time.monotonic`; None for never.
    """

    def __init__(self, states: Mapping[str, Any], interval: int, max_steps: int, deadline: float | None = None) -> None:
        self._states, self._interval, self._max_steps, self._deadline = states, interval, max_steps, deadline

    def setup(self, trainer: L.Trainer, learner: L.LightningModule, stage: str) -> None:
        for callback in _others(trainer, self):
            if callback.state_key in self._states:
                try:
                    callback.load_state_dict(self._states[callback.state_key])
                except Exception as error:
                    raise UserError(not_restored(f"the state of {callback.state_key}", error)) from error

    def on_train_batch_end(self, trainer: L.Trainer, learner: L.LightningModule, *_: Any) -> None:
        assert isinstance(learner, Learner)
        self._agree(trainer, learner)
        if learner.stop is not None or learner.step % self._interval == 0:
            learner.check_finite()

    def on_validation_end(self, trainer: L.Trainer, learner: L.LightningModule) -> None:
        assert isinstance(learner, Learner)
        self._agree(trainer, learner)

    def on_train_end(self, trainer: L.Trainer, learner: L.LightningModule) -> None:
        assert isinstance(learner, Learner)
        learner.check_finite()

    def _agree(self, trainer: L.Trainer, learner: Learner) -> None:
        if learner.stop is not None:
            return
        signum = interrupts.asked()
        time_up = self._deadline is not None and time.monotonic() >= self._deadline
        time_up = time_up and not _ended(trainer, learner.step, self._max_steps)
        own = int(time_up) if signum is None else 1 + signum  # 0: go on
        if trainer.world_size > 1:
            shared = torch.tensor(own, device=learner.device)
            dist.all_reduce(shared, op=dist.ReduceOp.MAX)
            own = int(shared)
        learner.stop = own - 1 if own else None


def _ended(trainer: L.Trainer, step: int, max_steps: int) -> bool:
    """Whether training is over: all steps are made, or a callback has ended it."""
    return step >= max_steps or trainer.should_stop


class Pruned(Exception):
    """A callback ends a run that does not promise enough; its message says why. The run can be resumed."""


class LastValidation(L.Callback):
    """Ends training at the last step in a way that makes Lightning validate once more there.

    Args:
        max_steps: the last step.
    """

    def __init__(self, max_steps: int) -> None:
        self._max_steps = max_steps

    def on_train_batch_end(self, trainer: L.Trainer, learner: L.LightningModule, *_: Any) -> None:
        assert isinstance(learner, Learner)
        if learner.step >= self._max_steps:
            trainer.should_stop = True


def _others(trainer: L.Trainer, own: L.Callback) -> list[L.Callback]:
    return [callback for callback in trainer.callbacks if callback is not own]  # type: ignore[attr-defined]


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
        if not trainer.is_global_zero:
            return  # every rank has the callbacks, one of them speaks
        self._first_step = learner.step
        self._meter = Meter("step", trainer.max_steps, learner.step, self._seconds)
        self._meter.__enter__()

    def on_train_batch_end(self, trainer: L.Trainer, learner: L.LightningModule, *_: Any) -> None:
        assert isinstance(learner, Learner)
        if self._meter is None:
            return
        if learner.step == self._first_step + 1:
            self._meter.restart(learner.step)  # the first step also pays for what is set up once
        elif self._meter.due():
            self._meter.show(learner.step, f"loss {learner.logged_loss:.1f}")

    def on_validation_end(self, trainer: L.Trainer, learner: L.LightningModule) -> None:
        assert isinstance(learner, Learner)
        if self._meter is None:
            return
        names = {"val/ari_fg": "ARI-FG", "val/msc_fg": "MSC-FG", "val/ari": "ARI", "val/msc": "MSC"}
        metrics = trainer.callback_metrics
        if "val/objects_present" in metrics:  # videos without labels
            names = {
                "val/loss": "loss",
                "val/objects_present": "objects per frame",
                "val/foreground_share": "their area",
            }
        scores = ", ".join(f"{short} {float(metrics[name]):.3f}" for name, short in names.items() if name in metrics)
        console.say(f"step {learner.step}, validation: {scores}")

    def teardown(self, trainer: L.Trainer, learner: L.LightningModule, stage: str) -> None:
        if self._meter is not None:
            self._meter.__exit__(None, None, None)
            self._meter = None
