"""Losses of 20 steps of APEX in one mode and precision, as JSON: python -m tests.training.losses cuda 8 tf32 eager.

A recipe comes by standard input. A fifth word is the first step's number (by default `where_all_counts`).
In a process of its own, because the type checks of the tests cannot be compiled (pytorch #122093).
"""

from __future__ import annotations

import json
import sys

import torch

from apex_lab.benchmark.work import Workload
from apex_lab.config.job import check_job
from apex_lab.config.schema import Config
from apex_lab.training.update import Mode

STEPS = 20


def where_all_counts(made: Workload, config: Config) -> int:
    """The first step at which no schedule and no loss weight is below half of what it ends with.

    At step 0 of APEX's recipe for P2D at `scale=cpu`, shadows, pixels in masks and two loss terms count for nothing.
    """
    values = [*made.update.schedules.schedules.values(), *made.update.weights.schedules.values()]
    last = config.trainer.max_steps
    return next(step for step in range(last + 1) if all(value(step) >= value(last) / 2 for value in values))


def losses(
    raw: dict[str, object], device: str, frames: int, precision: str, mode: Mode, start: int | None = None
) -> list[float]:
    """Loss of each step from `start` on, by default from where all counts.

    Compiled code draws the noise of eager code here, and float32 is without TF32.
    """
    torch._inductor.config.fallback_random = True
    torch.backends.cudnn.allow_tf32 = precision != "float32"
    config = check_job(raw, {}, needs_recipe=False).config
    made = Workload(config, torch.device(device), 2, frames, mode=mode)
    made.update.step = where_all_counts(made, config) if start is None else start
    found = []
    for _ in range(STEPS):
        made.train()
        found.append(made.update.latest["train/loss"].clone())
    return torch.stack(found).tolist()


if __name__ == "__main__":
    device, frames, precision, mode, *start = sys.argv[1:]
    assert mode in ("eager", "compiled", "cuda graph", "compiled cuda graph")
    print(json.dumps(losses(json.load(sys.stdin), device, int(frames), precision, mode, *map(int, start))))
