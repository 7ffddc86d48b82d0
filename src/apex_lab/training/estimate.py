"""What is tried before training starts: one frame, and on a CPU how long all of them will take."""

from __future__ import annotations

import copy
import time

import torch

from apex_lab.base import faults
from apex_lab.base.errors import UserError
from apex_lab.base.machine import bounded_memory
from apex_lab.base.progress import readable
from apex_lab.config.building import build_clip_frames, build_schedules, build_weights
from apex_lab.config.schema import Config
from apex_lab.scene import Context, Noise, SceneModel, schedule_at
from apex_lab.training.update import WeightUpdate, named_parameters, remember_rates

SMALL = 5e9
"""Pixels (of all batches together) up to which nothing is measured: twenty times what scale=cpu has."""

LONG = 3 * 3600.0
"""Seconds above which there is a warning."""


def try_out(config: Config, model: SceneModel) -> None:
    """Sends one frame through a model, so that parts that do not fit each other are found before the data are made.

    The model is left as it was. Nothing is tried where the size of the images is not known.

    Raises:
        UserError: it breaks.
    """
    size = config.data.get("image_size")
    height, width = model.input_size or (size, size)
    if model.needs_labels or not isinstance(height, int) or not isinstance(width, int):
        return
    schedule = schedule_at({name: each(0) for name, each in build_schedules(config).items()}, torch.device("cpu"))
    trained = model.training
    model.eval()
    try:
        with torch.random.fork_rng(devices=[]), torch.no_grad(), bounded_memory():
            model(torch.full((1, 1, 3, height, width), 0.5), Context(schedule=schedule, noise=Noise()))
    except UserError:
        raise
    except Exception as error:
        raise UserError(
            faults.told(error, f"model ({config.model['_target_']}) breaks at a frame of {height} x {width} pixels")
        ) from error
    finally:
        model.train(trained)


def warning(config: Config, model: SceneModel) -> str | None:
    """A warning for long training on a CPU; None if it is not long, or the data have no known size."""
    if "frames" not in config.data or "image_size" not in config.data or pixels(config) <= SMALL:
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
    return images(config) * config.data["image_size"] ** 2


def images(config: Config) -> int:
    """Frames of all batches together."""
    frames, steps = build_clip_frames(config), config.trainer.max_steps
    lengths = [frames(step * steps // 100) or config.data["frames"] for step in range(100)]
    return round(sum(lengths) / 100 * steps * config.clips.batch_size)


def seconds_on_cpu(config: Config, model: SceneModel) -> float:
    """Duration of one step on one clip of at most two frames, scaled up to all frames; the model is left as it was."""
    frames = min(2, build_clip_frames(config)(0) or config.data["frames"])
    update = WeightUpdate(copy.deepcopy(model).train(), build_schedules(config), build_weights(config))
    optimizer = remember_rates(torch.optim.SGD(named_parameters(update.model), lr=0.0))
    with torch.random.fork_rng(devices=[]):
        video = torch.randint(0, 256, (1, frames, 3, *2 * (config.data["image_size"],)), dtype=torch.uint8)
        for _ in range(2):  # the first step also pays for what is set up once
            began = time.perf_counter()
            update(video, optimizer)
            seconds = time.perf_counter() - began
    return seconds / frames * images(config)
