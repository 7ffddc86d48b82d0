"""How long training will take on a CPU, told before it starts."""

from __future__ import annotations

import copy
import time

import torch

from apex_lab.base.progress import readable
from apex_lab.config.schema import Config, build_schedules, build_weights
from apex_lab.scene import SceneModel, schedule_at

SMALL = 5e9
"""Pixels (of all batches together) up to which nothing is measured: twenty times what scale=cpu has."""

LONG = 3 * 3600.0
"""Seconds above which a person is told."""


def warning(config: Config, model: SceneModel) -> str | None:
    """What to tell a person who starts long training on a CPU; None if it is not long."""
    if pixels(config) <= SMALL:
        return None
    seconds = seconds_on_cpu(config, model)
    if seconds <= LONG:
        return None
    return (
        f"Training will take about {readable(seconds)} on this CPU (an estimate, from one short step); "
        "scale=cpu is made for CPUs: python -m apex_lab.train scale=cpu"
    )


def pixels(config: Config) -> int:
    """Pixels that training looks at, each batch counted."""
    data = config.data
    return config.trainer.max_steps * data["batch_size"] * data["frames"] * data["image_size"] ** 2


def seconds_on_cpu(config: Config, model: SceneModel) -> float:
    """Duration of one step on one video of two frames, scaled up to all steps; the model is left as it was."""
    frames, side = min(2, config.data["frames"]), config.data["image_size"]
    schedule = schedule_at({name: value(0) for name, value in build_schedules(config).items()})
    weights = {name: value(0) for name, value in build_weights(config).items()}
    model = copy.deepcopy(model).train()
    with torch.random.fork_rng(devices=[]):
        video = torch.rand(1, frames, 3, side, side)
        for _ in range(2):  # the first step also pays for what is set up once
            began = time.perf_counter()
            terms = model(video, schedule).terms
            torch.stack([terms[name].sum() * weight for name, weight in weights.items()]).sum().backward()
            seconds = time.perf_counter() - began
    return seconds / frames * config.data["frames"] * config.data["batch_size"] * config.trainer.max_steps
