"""APEX against its straightforward variant: who trains more frames per second, measured in turns."""

from __future__ import annotations

import copy
import statistics
import time
from dataclasses import dataclass
from typing import Any

import torch

from apex_lab import components
from apex_lab.benchmark.measure import once, spread
from apex_lab.benchmark.straightforward import Straightforward
from apex_lab.benchmark.work import Workload
from apex_lab.config import Config
from apex_lab.models.apex import Apex

STRAIGHTFORWARD = "straightforward"
RENDERS_AS_MANY = "straightforward, renders as many"


@dataclass(frozen=True)
class Comparison:
    """What to compare on.

    Attributes:
        config: of the run; its model is an `Apex`.
        device: "cpu" or "cuda".
        batch_size, frames: of the batch, the same for all.
        warmup, repeats: rounds before and during the measurement; in each, every model makes one step.
    """

    config: Config
    device: str
    batch_size: int
    frames: int
    warmup: int
    repeats: int


def straightforward(config: Config, model: Apex, render_top: int | None) -> Straightforward:
    """The variant of a model that the configuration builds, as wide and with the same weights.

    Args:
        config: what `model` was built from.
        model: whose weights are taken.
        render_top: how many cells of discovery are rendered; None renders all.
    """
    node = copy.deepcopy(config.model)
    node.update(_target_=f"{Straightforward.__module__}.{Straightforward.__name__}", render_top=render_top)
    variant = components.build(node, "model")
    assert isinstance(variant, Straightforward)
    variant.load_state_dict(model.state_dict())
    return variant


def compare(asked: Comparison) -> dict[str, Any]:
    """Frames per second of APEX and of both variants, and the ratios, round by round.

    On the CPU the ratios are told once more in processor time, which other programs on the machine disturb less.
    """
    device = torch.device(asked.device)

    def work(model: Apex | None) -> Workload:
        return Workload(asked.config, device, asked.batch_size, asked.frames, model)

    fast = work(None)
    assert isinstance(fast.model, Apex)
    works = {
        "apex": fast,
        STRAIGHTFORWARD: work(straightforward(asked.config, fast.model, None)),
        RENDERS_AS_MANY: work(straightforward(asked.config, fast.model, fast.model.render_top)),
    }
    steps = {name: each.step(training=True) for name, each in works.items()}
    seconds: dict[str, list[float]] = {name: [] for name in works}
    processor: dict[str, list[float]] = {name: [] for name in works}
    with torch.random.fork_rng(devices=[]):
        for i in range(asked.warmup + asked.repeats):
            for name, step in steps.items():
                began = time.process_time()
                passed = once(step, device)
                if i >= asked.warmup:
                    seconds[name].append(passed)
                    processor[name].append(time.process_time() - began)
    ratios, in_processor_time = ({n: _ratios(times["apex"], times[n]) for n in works} for times in (seconds, processor))
    return {
        "device": asked.device,
        "batch_size": asked.batch_size,
        "frames": asked.frames,
        "rounds": asked.repeats,
        "models": {
            name: {
                **spread(seconds[name], fast.frames),
                "apex_trains_times_as_many": statistics.median(ratios[name]),
                "times_min_max": [min(ratios[name]), max(ratios[name])],
                "times_in_processor_time": statistics.median(in_processor_time[name])
                if asked.device == "cpu"
                else None,
                "processor_seconds": statistics.median(processor[name]),
            }
            for name in works
        },
    }


def _ratios(ours: list[float], theirs: list[float]) -> list[float]:
    """Round by round, how many times as long theirs took."""
    return [b / a for a, b in zip(ours, theirs, strict=True)]
