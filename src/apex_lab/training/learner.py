"""The one LightningModule: trains and validates any `SceneModel`.

Everything that depends on progress depends on `Learner.step`, the number of weight updates made: schedules, the order
of the data, and the noise, whose generator is seeded anew for every step. So a run that was stopped after any step goes
on exactly as if it had not been.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import lightning as L
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn
from torch.optim import Optimizer

from apex_lab.base.errors import UserError
from apex_lab.metrics import SceneMetrics, scene_identities
from apex_lab.metrics.scenes import background_identities
from apex_lab.scene import Scene, SceneModel, Schedule
from apex_lab.training.schedules import Constant

Batch = Mapping[str, Any]
"""`video` uint8 (B, T, 3, H, W), `segmentation` uint8 (B, T, H, W), `index` int (B,)."""

Values = Mapping[str, Callable[[int], float]]
"""Name -> schedule."""

UNSCALED = Constant(1.0)


class Learner(L.LightningModule):
    """Optimises the weighted sum of a model's loss terms and logs each of them by name.

    Args:
        model: what is trained.
        optimizer: weights -> optimiser over them.
        schedules: the values that the model's forward takes.
        weights: loss term -> its weight.
        lr_scale: what all of the optimiser's learning rates are multiplied by.
        seed: of the noise.
        gradient_clip_norm: gradients are scaled down to this norm; None leaves them.
        log_interval: steps between two logged steps.
        step: weight updates already made.
    """

    def __init__(
        self,
        model: SceneModel,
        optimizer: Callable[[list[nn.Parameter]], Optimizer],
        schedules: Values,
        weights: Values,
        seed: int = 0,
        gradient_clip_norm: float | None = None,
        log_interval: int = 1,
        step: int = 0,
        lr_scale: Callable[[int], float] = UNSCALED,
    ) -> None:
        super().__init__()
        self.model = model
        self.step = step
        self.seed = seed
        self.latest: dict[str, Tensor] = {}
        self.logged_loss = math.nan
        self._optimizer = optimizer
        self._schedules = schedules
        self._weights = weights
        self._clip_norm = gradient_clip_norm
        self._log_interval = log_interval
        self._lr_scale = lr_scale
        self._validation = SceneMetrics()
        self._validation_sums: dict[str, Tensor] = {}
        self._validation_videos = 0
        self._clock, self._frames = 0.0, 0

    def configure_optimizers(self) -> Optimizer:
        optimizer = self._optimizer([p for p in self.model.parameters() if p.requires_grad])
        for group in optimizer.param_groups:
            group.setdefault("initial_lr", group["lr"])  # the name that PyTorch's schedulers store it under, too
        return optimizer

    def schedule(self) -> Schedule:
        """The scheduled values at this step; filled on the device, so that nothing waits for a copy."""
        return {name: torch.full((), value(self.step), device=self.device) for name, value in self._schedules.items()}

    def loss(self, terms: Mapping[str, Float[Tensor, " B"]]) -> Float[Tensor, ""]:
        """The batch's mean of the weighted sum of terms.

        Raises:
            UserError: the model gives other terms than those that the configuration weighs.
        """
        if terms.keys() != self._weights.keys():
            raise UserError(f"The model gives the loss terms {sorted(terms)}, loss has {sorted(self._weights)}.")
        # a weight of 0 takes a term out, even where it is not finite
        parts = [terms[name].mean() * w for name, weight in self._weights.items() if (w := weight(self.step)) != 0]
        return torch.stack(parts).sum()

    def on_train_start(self) -> None:
        self._clock, self._frames = time.perf_counter(), 0

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        torch.manual_seed(noise_seed(self.seed, self.step))
        scene: Scene = self.model(as_float(batch["video"]), self.schedule())
        loss = self.loss(scene.terms)
        self.latest = {
            "train/loss": loss.detach(),
            **{f"train/{name}": term.detach().mean() for name, term in scene.terms.items()},
            **{f"diagnostics/{name}": value.detach() for name, value in scene.diagnostics.items()},
        }
        self._frames += batch["video"].shape[0] * batch["video"].shape[1]
        return loss

    def configure_gradient_clipping(self, optimizer: Optimizer, *_: Any, **__: Any) -> None:
        limit = math.inf if self._clip_norm is None else self._clip_norm
        self.latest["train/gradient_norm"] = nn.utils.clip_grad_norm_(self.model.parameters(), limit).detach()

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """One weight update and, every `log_interval` updates, its row in the curves."""
        optimizer = self.optimizers(use_pl_optimizer=False)
        assert isinstance(optimizer, Optimizer)
        for group in optimizer.param_groups:
            group["lr"] = group["initial_lr"] * self._lr_scale(self.step)
        super().optimizer_step(*args, **kwargs)
        values = {name: value(self.step) for name, value in self._schedules.items()}
        values["lr"] = optimizer.param_groups[0]["lr"]
        self.step += 1
        if self.step % self._log_interval == 0 or self.step == 1:
            row = self.fetch()
            self.logged_loss = row["train/loss"]
            row.update({f"schedule/{name}": value for name, value in values.items()})
            now = time.perf_counter()
            row["train/frames_per_second"] = self._frames / max(now - self._clock, 1e-9)
            self._clock, self._frames = now, 0
            self._record(row)

    def fetch(self) -> dict[str, float]:
        """The latest step's values as numbers, in one copy from the device.

        Raises:
            UserError: loss or gradient norm is not finite.
        """
        names = list(self.latest)
        values = torch.stack([self.latest[name].float() for name in names]).tolist()
        row = dict(zip(names, values, strict=True))
        for name in ("train/loss", "train/gradient_norm"):
            if not math.isfinite(row.get(name, 0.0)):
                broken = [n for n in names if not math.isfinite(row[n])]
                raise UserError(
                    f"{name} is {row[name]} at step {self.step} (not finite: {', '.join(broken)}): "
                    "try a lower optimizer.lr, a lower trainer.gradient_clip_norm or another seed."
                )
        return row

    def on_validation_epoch_start(self) -> None:
        self._validation.reset()
        self._validation_sums, self._validation_videos = {}, 0

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        video, truth = as_float(batch["video"]), batch["segmentation"].long()
        scene = self.model(video, self.schedule())
        identities = scene_identities(scene, truth.shape[-2:])
        self._validation.update(identities, truth)
        values = {"loss": self.loss(scene.terms).expand(len(video)), **scene.terms}
        if bool(scene.background.any()):
            values["foreground_share"] = foreground_share(scene, identities)
        for name, value in values.items():
            self._validation_sums[name] = self._validation_sums.get(name, torch.zeros_like(value[0])) + value.sum()
        self._validation_videos += len(video)

    def on_validation_epoch_end(self) -> None:
        row = {f"val/{name}": float(value) / self._validation_videos for name, value in self._validation_sums.items()}
        row.update({f"val/{name}": float(value) for name, value in self._validation.compute().items()})
        for name, value in row.items():
            self.log(name, value, logger=False)
        self._record(row)
        self._clock, self._frames = time.perf_counter(), 0

    def _record(self, row: dict[str, float]) -> None:
        for logger in self.trainer.loggers:
            logger.log_metrics(row, step=self.step)


class Stretches(Iterable[Batch]):
    """Cuts one endless-looking pass over batches into stretches that end where validation is due.

    Lightning takes each stretch for an epoch and validates at its end. A run that goes on from a step in the middle of
    a stretch begins with a shorter one, so validations stay at the same steps.

    Args:
        batches: all batches from the learner's step on.
        learner: whose step is read.
        interval: steps between validations; None is one single stretch.
    """

    def __init__(self, batches: Iterable[Batch], learner: Learner, interval: int | None) -> None:
        self._batches = batches
        self._iterator: Iterator[Batch] | None = None
        self._learner = learner
        self._interval = interval

    def __iter__(self) -> Iterator[Batch]:
        if self._iterator is None:
            self._iterator = iter(self._batches)
        # counted here, not read from the learner at every batch, because the loop fetches one batch ahead
        step = self._learner.step
        while True:
            batch = next(self._iterator, None)
            if batch is None:
                return
            yield batch
            step += 1
            if self._interval is not None and step % self._interval == 0:
                return


def as_float(video: UInt8[Tensor, "B T 3 H W"]) -> Float[Tensor, "B T 3 H W"]:
    """RGB in [0, 1] from bytes, on the device where the bytes are."""
    return video.float() / 255.0


def foreground_share(scene: Scene, identities: Int[Tensor, "B T H W"]) -> Float[Tensor, " B"]:
    """Share of a video's pixels that the model gives to objects, not to its background."""
    backgrounds = background_identities(scene)
    given = [
        torch.isin(video, video.new_tensor(sorted(ids))) for video, ids in zip(identities, backgrounds, strict=True)
    ]
    return torch.stack([1.0 - background.float().mean() for background in given])


def noise_seed(seed: int, step: int) -> int:
    """A generator seed for one step of one run; neighbouring seeds and steps give unrelated numbers (splitmix64)."""
    mask = 2**64 - 1
    value = (seed * 0x9E3779B97F4A7C15 + step + 1) & mask
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        value = ((value ^ (value >> shift)) * factor) & mask
    return (value ^ (value >> 31)) & (2**63 - 1)
