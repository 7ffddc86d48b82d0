"""Losses of APEX's first steps in one mode and precision, as JSON: python -m tests.training.losses cuda cpu tf32 eager.

In a process of its own, because the type checks of the tests cannot be compiled (pytorch #122093).
"""

from __future__ import annotations

import json
import sys

import torch

from apex_lab.benchmark.work import Workload
from apex_lab.config.job import check_job
from apex_lab.training.update import Mode

STEPS = 20


def losses(raw: dict[str, object], device: str, frames: int, precision: str, mode: Mode) -> list[float]:
    """Loss of each step; compiled code draws the noise of eager code here, and float32 is without TF32."""
    torch._inductor.config.fallback_random = True
    torch.backends.cudnn.allow_tf32 = precision != "float32"
    made = Workload(check_job(raw, {}, needs_recipe=False).config, torch.device(device), 2, frames, mode=mode)
    made.update.step = 0
    found = []
    for _ in range(STEPS):
        made.train()
        found.append(made.update.latest["train/loss"].clone())
    return torch.stack(found).tolist()


if __name__ == "__main__":
    device, frames, precision, mode = sys.argv[1:]
    assert mode in ("eager", "compiled", "cuda graph", "compiled cuda graph")
    print(json.dumps(losses(json.load(sys.stdin), device, int(frames), precision, mode)))
