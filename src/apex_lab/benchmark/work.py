"""The work that is measured: one training step and one inference, as `python -m apex_lab.train` does them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from apex_lab.benchmark.profile import Clock, watched
from apex_lab.config.schema import Config, build_model, build_optimizer, build_schedules, build_weights
from apex_lab.scene import SceneModel
from apex_lab.training.learner import Learner, as_float


class Workload:
    """A model, its optimiser and one batch of random videos, all on the device.

    Args:
        config: the run whose steps are measured; schedules stand where they are in the middle of it.
        device: where.
        batch_size, frames: of the batch; its images are as large as `data.image_size`.
        model: what to measure, as it is; by default what the configuration builds, as training from scratch begins.
    """

    def __init__(
        self, config: Config, device: torch.device, batch_size: int, frames: int, model: SceneModel | None = None
    ) -> None:
        side = config.data["image_size"]
        noise = torch.Generator().manual_seed(config.seed)
        video = torch.randint(0, 256, (batch_size, frames, 3, side, side), dtype=torch.uint8, generator=noise)
        self.device, self.precision = device, config.trainer.precision
        self.frames = batch_size * frames
        self.batch = {"video": video.to(device)}
        self.model = build_model(config) if model is None else model
        if model is None:
            self.model.initialise(as_float(video).mean((0, 1)))
        self.learner = Learner(
            self.model,
            lambda parameters: build_optimizer(config, parameters),
            build_schedules(config),
            build_weights(config),
            seed=config.seed,
            gradient_clip_norm=config.trainer.gradient_clip_norm,
            step=config.trainer.max_steps // 2,
        ).to(device)
        self.optimizer = self.learner.configure_optimizers() if self.model.needs_training else None

    @contextlib.contextmanager
    def _autocast(self) -> Iterator[None]:
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.precision == "bf16-mixed"):
            yield

    def train(self, clock: Clock | None = None) -> None:
        """One weight update: forward, loss, backward, clipping, optimiser."""
        assert self.optimizer is not None
        clock = Clock(torch.device("cpu")) if clock is None else clock
        torch.compiler.cudagraph_mark_step_begin()  # what the last step returned is not needed any more
        self.optimizer.zero_grad(set_to_none=True)
        with self._autocast():
            loss = self.learner.training_step(self.batch, 0)
        with clock.part("backward"):
            loss.backward()
        with clock.part("update"):
            self.learner.configure_gradient_clipping(self.optimizer)
            self.optimizer.step()
        self.learner.step += 1

    @torch.inference_mode()
    def infer(self) -> Tensor:
        """Masks of the batch."""
        torch.compiler.cudagraph_mark_step_begin()
        with self._autocast():
            return self.model(as_float(self.batch["video"]), self.learner.schedule()).masks

    def step(self, training: bool) -> Callable[[], object]:
        """What one step is, after the model was brought into the mode for it."""
        self.model.train(training)
        return self.train if training else self.infer

    def seconds_by_part(self, training: bool) -> dict[str, float]:
        """One step with a clock beside it; not for compiled models, whose parts are one."""
        clock = Clock(self.device)
        self.model.train(training)
        with watched(self.model, clock):
            clock.start()
            if training:
                self.train(clock)
            else:
                self.infer()
            return clock.stop()
