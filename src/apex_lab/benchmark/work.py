"""The work that is measured: one weight update and one inference, by the objects that training and evaluation use."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from apex_lab.base.memory import keep_freed_memory
from apex_lab.config.building import (
    build_clip_frames,
    build_lr_scale,
    build_model,
    build_optimizer,
    build_schedules,
    build_weights,
)
from apex_lab.config.schema import Config
from apex_lab.data import Clip, Sprites
from apex_lab.inference.predictor import Predictor
from apex_lab.scene import SceneModel, Statistics
from apex_lab.training.devices import set_matmul_precision
from apex_lab.training.update import Mode, WeightUpdate, named_parameters, remember_rates

COUNTS = (2, 4)
"""Fewest and most sprites of a video, as in `data=sprites`."""


class Workload:
    """A model, its optimiser and one batch of clips of moving sprites, all on the device.

    On random images a model finds no object, and a twin that skips what is not there would have nothing to do.

    Args:
        config: the run whose steps are measured; schedules stand where they are in the middle of it.
        device: where.
        batch_size, frames: of the batch; its images are as large as `data.image_size`.
        model: what to measure, as it is; by default what the configuration builds, as training from scratch begins.
        mode: how a step is carried out.
    """

    def __init__(
        self,
        config: Config,
        device: torch.device,
        batch_size: int,
        frames: int,
        model: SceneModel | None = None,
        mode: Mode = "eager",
    ) -> None:
        side = config.data["image_size"]
        noise = torch.Generator().manual_seed(config.seed)
        clips = Sprites(config.seed, "train", batch_size, frames, side, COUNTS)
        video = torch.stack([clips.read(Clip(i))["video"] for i in range(batch_size)])
        self.device, self.frames, self.video = device, batch_size * frames, video.to(device)
        self.model = build_model(config) if model is None else model
        if model is None:
            median = torch.rand(3, *(self.model.input_size or (side, side)), generator=noise)
            self.model.initialise(Statistics(lambda: median))
        self.model.to(device)
        set_matmul_precision(device, config.trainer.matmul_precision)
        if model is None:  # as training does; a twin is measured as plain PyTorch
            keep_freed_memory()
        self.update = WeightUpdate(
            self.model,
            build_schedules(config),
            build_weights(config),
            build_lr_scale(config),
            config.trainer.gradient_clip_norm,
            config.seed,
            config.trainer.precision,
            config.trainer.max_steps // 2,
            mode,
        ).to(device)
        self.update.write()
        self.optimizer = (
            remember_rates(build_optimizer(config, named_parameters(self.model)), self.update.captured)
            if self.model.needs_training
            else None
        )
        self.predictor = Predictor(self.model, self.update.schedules.tensors(), device, config.trainer.precision)

    def train(self) -> None:
        """One weight update."""
        assert self.optimizer is not None
        self.model.train()
        self.update(self.video, self.optimizer)

    def infer(self) -> Tensor:
        """Masks of the batch."""
        return self.predictor({"video": self.video, "name": [f"video {i}" for i in range(len(self.video))]}).masks

    def step(self, training: bool) -> Callable[[], object]:
        """One step as a function."""
        return self.train if training else self.infer

    @contextlib.contextmanager
    def rewound(self) -> Iterator[None]:
        """Steps made inside are taken back at the end, so that the next ones do the same work again.

        The number of the step, which seeds its noise, and the weights are set back; the optimiser keeps its state,
        which no forward or backward pass depends on.
        """
        number, weights = self.update.step, copy.deepcopy(self.model.state_dict())
        try:
            yield
        finally:
            self.update.step = number
            self.model.load_state_dict(weights)


def clip_length(config: Config) -> int:
    """Frames of a clip in the middle of training."""
    return build_clip_frames(config)(config.trainer.max_steps // 2) or int(config.data["frames"])
