"""The one LightningModule: trains and validates any `SceneModel`.

Everything that depends on progress depends on the number of weight updates made (`WeightUpdate.step`): schedules, the
order of the data, and the noise, whose generator is seeded again for every step. So a run that was stopped after any
step resumes exactly as if it had not been.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import lightning as L
import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.optim import Optimizer

from apex_lab.base.errors import UserError
from apex_lab.base.validation import one_line
from apex_lab.data.video_set import VideoSet
from apex_lab.evaluation.score import Onlooker, Tally, add_batch, video_set
from apex_lab.evaluation.scoring import ScoringPart
from apex_lab.inference.predictor import Batch, Predictor
from apex_lab.metrics.keys import VALIDATION_SCORES
from apex_lab.scene import SceneModel, schedule_at
from apex_lab.training import watch
from apex_lab.training.schedules import in_evaluation
from apex_lab.training.update import WeightUpdate, named_parameters, remember_rates
from apex_lab.training.watch import Seen, Watch

DECISIVE = ("train/loss", "train/gradient_norm")
"""What must be finite at every update."""


class Diverged(UserError):
    """Loss or gradient is not finite."""


class Learner(L.LightningModule):
    """Makes weight updates, logs each loss term by name, and validates by the evaluation's scoring path.

    Args:
        update: the weight update.
        optimizer: named parameters -> optimiser over them.
        log_interval: steps between two logged steps.
        rank, ranks: which process this is, of how many.
        folder: where rank 0 keeps the batch of an update that is not finite; None: nowhere.

    Attributes:
        stop: why training stops before its next step (`apex_lab.training.callbacks.Lockstep` sets it): the number of a
            signal, 0 when time is up; None to go on.
        onlookers: called with every batch of validation and the model's scene of it.
    """

    def __init__(
        self,
        update: WeightUpdate,
        optimizer: Callable[[list[tuple[str, nn.Parameter]]], Optimizer],
        log_interval: int = 1,
        rank: int = 0,
        ranks: int = 1,
        folder: Path | None = None,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.update = update
        self.logged_loss = math.nan
        self.stop: int | None = None
        self.onlookers: list[Onlooker] = []
        self._optimizer, self._log_interval = optimizer, log_interval
        self._rank, self._ranks, self._folder = rank, ranks, folder
        # a loss that is not finite on one rank makes the gradient, which is common, so on all: they stop together
        self._watch = Watch(DECISIVE if ranks == 1 else DECISIVE[1:])
        self._scoring = ScoringPart()
        self._tally: Tally | None = None
        self._clock, self._frames = 0.0, 0

    @property
    def step(self) -> int:
        """Weight updates made."""
        return self.update.step

    def configure_optimizers(self) -> Optimizer:
        return remember_rates(self._optimizer(named_parameters(self.update.model)), self.update.captured)

    def on_train_start(self) -> None:
        self._restart_clock()

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> int | None:
        """-1 ends Lightning's loop here, without the validation that a stop inside a step would bring."""
        return None if self.stop is None else -1

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """The model itself."""
        return self.update.model(*args, **kwargs)

    def training_step(self, batch: Batch, batch_idx: int) -> None:
        """One weight update and, every `log_interval` updates, its row in the curves."""
        optimizer = self.optimizers()
        assert not isinstance(optimizer, list)
        raw = self.raw_optimizer()
        step = self.step
        self.update(batch["video"], raw, self._rank, self._ranks, self.manual_backward, optimizer.step)
        if self.update.captured:  # it has gone past Lightning, which counts updates too
            counted = self.trainer.fit_loop.epoch_loop.manual_optimization.optim_step_progress.total
            counted.ready = counted.completed = self.step
        self._frames += batch["video"].shape[0] * batch["video"].shape[1] * self._ranks
        self._refuse(self._watch.add(self.step, self.update.latest, batch))
        if self.step % self._log_interval == 0 or self.step == 1:
            self._log(step, raw.param_groups[0]["lr"])

    def raw_optimizer(self) -> Optimizer:
        """PyTorch's optimiser, without Lightning's wrapper."""
        optimizer = self.optimizers(use_pl_optimizer=False)
        assert isinstance(optimizer, Optimizer)
        return optimizer

    def _log(self, step: int, rate: Any) -> None:
        self.check_finite()
        row = self.fetch()
        self.logged_loss = row["train/loss"]
        schedules = self.update.schedules.schedules
        row.update({f"schedule/{name}": float(schedule(step)) for name, schedule in schedules.items()})
        row["schedule/lr"] = float(rate)
        row["train/frames_per_second"] = self._frames / max(time.perf_counter() - self._clock, 1e-9)
        self._restart_clock()
        self._record(row)

    def fetch(self) -> dict[str, float]:
        """The latest step's values as numbers, averaged over ranks (so all must call), in one copy from the device.

        Raises:
            Diverged: loss or gradient norm is not finite.
        """
        names = list(self.update.latest)
        stacked = torch.stack([self.update.latest[name].float() for name in names])
        if self._ranks > 1:
            dist.all_reduce(stacked)
            stacked /= self._ranks
        row = dict(zip(names, stacked.tolist(), strict=True))
        if not all(math.isfinite(row.get(name, 0.0)) for name in DECISIVE):
            raise self._diverged(self.step, row, "")
        return row

    def check_finite(self) -> None:
        """Looks at every update so far, whatever the device is still doing.

        Raises:
            Diverged: loss or gradient norm of one is not finite.
        """
        self._refuse(self._watch.look())

    def _refuse(self, seen: Seen | None) -> None:
        """Ends training at an update that is not finite, with its batch kept; all ranks get here at the same step."""
        if seen is None:
            return
        if self._ranks > 1:
            seen = _of_all_ranks(seen, self._ranks, self.device)
        kept = ""
        if self._folder is not None and self._rank == 0:
            try:
                kept = f"; its batch is kept in {watch.keep(self._folder, seen)}"
            except UserError as error:
                kept = f"; its batch could not be kept: {one_line(error).rstrip('.')}"
        raise self._diverged(seen.step, seen.row, kept)

    def _diverged(self, step: int, row: Mapping[str, float], kept: str) -> Diverged:
        name = next(name for name in DECISIVE if not math.isfinite(row.get(name, 0.0)))
        broken = [n for n, value in row.items() if not math.isfinite(value)]
        return Diverged(
            f"{name} is {row[name]} at step {step} (not finite: {', '.join(broken)}{kept}): "
            "try a lower optimizer.lr, a lower trainer.gradient_clip_norm or another seed."
        )

    def on_validation_epoch_start(self) -> None:
        self.check_finite()
        self.update.write()
        model = self.update.model
        self._tally = Tally.empty(self._scoring.settings(model.tracks))
        self._predictor = Predictor(
            model, self._in_evaluation(model), self.device, self.update.precision, seed=self.update.seed
        )

    def _in_evaluation(self, model: SceneModel) -> dict[str, Tensor]:
        """The scheduled values of validation."""
        return schedule_at(in_evaluation(self.update.schedules.schedules, model, self.step), self.device)

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        assert self._tally is not None
        add_batch(self._tally, self._predictor, batch, self._videos(), self._scoring, self.onlookers)

    def on_validation_epoch_end(self) -> None:
        assert self._tally is not None
        tally = _gathered(self._tally, self._ranks)
        self._tally = None
        terms = tally.mean_terms()
        row = {f"val/{name}": value for name, value in terms.items()}
        tensors = {name: torch.tensor([value], device=self.device) for name, value in terms.items()}
        row["val/loss"] = float(self.update.objective(tensors)) if terms else math.nan
        share = tally.mean_share()
        if share is not None:
            row["val/foreground_share"] = share
        if not self._videos().labelled:
            row["val/objects_present"] = tally.mean_present()
        if tally.evaluator.records:
            total = tally.evaluator.result()["total"]
            row.update({f"val/{k}": total[k] for k in VALIDATION_SCORES if not math.isnan(total.get(k, math.nan))})
        for name, value in row.items():
            self.log(name, value, logger=False, sync_dist=self._ranks > 1)
        self._record(row)
        self._restart_clock()

    def _videos(self) -> VideoSet:
        loader = self.trainer.val_dataloaders
        assert loader is not None
        return video_set(loader)

    def _restart_clock(self) -> None:
        self._clock, self._frames = time.perf_counter(), 0

    def _record(self, row: dict[str, float]) -> None:
        for logger in self.trainer.loggers:
            logger.log_metrics(row, step=self.step)


def _of_all_ranks(seen: Seen, ranks: int, device: torch.device) -> Seen:
    """An update with the clips of all ranks, and the means of its values."""
    values = torch.tensor(list(seen.row.values()), device=device)
    dist.all_reduce(values)
    row = dict(zip(seen.row, (values / ranks).tolist(), strict=True))
    shares: list[Any] = [None] * ranks
    mine = {key: value.cpu() if isinstance(value, torch.Tensor) else value for key, value in seen.batch.items()}
    dist.all_gather_object(shares, mine)
    batch = {
        key: torch.cat([share[key] for share in shares])
        if isinstance(value, torch.Tensor)
        else [item for share in shares for item in share[key]]
        for key, value in mine.items()
    }
    return Seen(seen.step, row, batch)


def _gathered(tally: Tally, ranks: int) -> Tally:
    """The scores of all ranks' videos, on every rank."""
    if ranks == 1:
        return tally
    found: list[Tally | None] = [None] * ranks
    dist.all_gather_object(found, tally)
    whole = Tally.empty(tally.evaluator.settings)
    for each in found:
        assert each is not None
        whole.merge(each)
    return whole
