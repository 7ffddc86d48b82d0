"""What a configuration asks for, built: model, optimiser, schedules, and the device for them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

from apex_lab.base.errors import UserError
from apex_lab.config import components, limits
from apex_lab.config.schema import Config
from apex_lab.scene import SceneModel
from apex_lab.training.schedules import Constant


def device(accelerator: str, key: str = "accelerator") -> torch.device:
    """The device that a key of the configuration asks for.

    Args:
        accelerator: "auto", "cpu" or "gpu".
        key: its name, for the sentence.

    Raises:
        UserError: a GPU is asked for and there is none.
    """
    if accelerator == "gpu" and not torch.cuda.is_available():
        word = key.partition(".")[0]  # trainer=cpu, accelerator=cpu
        raise UserError(f"{key} = 'gpu', but PyTorch finds no CUDA device: use {word}=cpu or {word}=auto.")
    return torch.device("cuda" if accelerator != "cpu" and torch.cuda.is_available() else "cpu")


def build_model(config: Config) -> SceneModel:
    """The model with weights drawn from the seed alone; the caller's random state is left as it was.

    Raises:
        UserError: the constructor refuses its values, or it is no `SceneModel`.
    """
    with torch.random.fork_rng(devices=[]), limits.bounded():
        torch.manual_seed(config.seed)
        model = components.build(config.model, "model")
    if not isinstance(model, SceneModel):
        raise UserError(f"model._target_ = {config.model['_target_']!r} is not an apex_lab.scene.SceneModel.")
    return model


def build_optimizer(config: Config, parameters: Sequence[tuple[str, torch.nn.Parameter]]) -> torch.optim.Optimizer:
    """The optimiser over the given parameters, which it gets with their names.

    Raises:
        UserError: none is configured, or its constructor refuses its values.
    """
    if config.optimizer is None:
        raise UserError("optimizer = null, but the model has weights to train: choose one, such as torch.optim.Adam.")
    optimizer = components.build(config.optimizer, "optimizer", params=parameters)
    if not isinstance(optimizer, torch.optim.Optimizer):
        raise UserError(f"optimizer._target_ = {config.optimizer['_target_']!r} is not a torch.optim.Optimizer.")
    return optimizer


def build_schedules(config: Config) -> dict[str, Callable[[int], float]]:
    """Schedule name -> schedule, as the model's forward takes them."""
    return {name: components.build(node, f"schedule.{name}") for name, node in config.schedule.items()}


def build_weights(config: Config) -> dict[str, Callable[[int], float]]:
    """Loss term -> its weight as a schedule; a number is a weight that never changes."""
    return {name: _build_value(value, f"loss.{name}") for name, value in config.loss.items()}


def build_lr_scale(config: Config) -> Callable[[int], float]:
    """The factor of all learning rates, as a schedule."""
    return _build_value(config.lr_scale, "lr_scale")


def build_clip_frames(config: Config) -> Callable[[int], int | None]:
    """Frames of a training clip as a function of the step; None: whole videos."""
    frames = config.clips.frames
    if isinstance(frames, dict):
        schedule = components.build(frames, "clips.frames")
        return lambda step: int(schedule(step))
    return lambda step: frames


def _build_value(value: float | dict[str, Any], key: str) -> Callable[[int], float]:
    """A schedule; a number is one that never changes."""
    return components.build(value, key) if isinstance(value, dict) else Constant(value)
