"""The learning rate's scale of Slot Attention; belongs beside the other schedules."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from apex_lab.schedules import Schedule, Steps


@dataclass(frozen=True)
class WarmupDecay(Schedule):
    """From 0 in a straight line over `warmup` steps, times an exponential that halves every `half_life` steps.

    Both count from step 0, so the decay runs during the warm-up too: with 10,000 and 100,000 the largest value is
    0.933, at step 10,000 (slot_attention.md section 1).
    """

    warmup: Steps
    half_life: Annotated[int, Field(gt=0)]

    def __call__(self, step: int) -> float:
        rise = min(1.0, step / self.warmup) if self.warmup else 1.0
        return rise * 0.5 ** (step / self.half_life)
