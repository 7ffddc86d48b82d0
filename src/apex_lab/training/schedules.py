"""Values that depend on training progress (temperatures, priors, loss weights): schedule(step) -> float.

A step is the number of weight updates already made, so the first batch sees step 0. Schedules are pure functions of the
step: a resumed run sees the same values as an unbroken one.
"""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from apex_lab.nn.noise import mixed
from apex_lab.scene import SceneModel

Steps = Annotated[int, Field(ge=0)]


class Schedule(ABC):
    """A number as a function of the training step."""

    @abstractmethod
    def __call__(self, step: int) -> float:
        """The value that the batch after `step` weight updates is trained with."""


END = 100_000_000
"""A step at which schedules have their last value; the published evaluation of SPACE passes it (space.md section 8)."""


def in_evaluation(schedules: Mapping[str, Callable[[int], float]], model: SceneModel, step: int) -> dict[str, float]:
    """The scheduled values that validation and evaluation call a model with after `step` weight updates."""
    at = END if model.evaluates_at_end else step
    return {name: float(schedule(at)) for name, schedule in schedules.items()}


@dataclass(frozen=True)
class Constant(Schedule):
    """The same value at every step."""

    value: float

    def __call__(self, step: int) -> float:
        return float(self.value)


@dataclass(frozen=True)
class _Ramp(Schedule):
    """From `start` to `end` over `steps` steps after a `delay`; constant before and after.

    With `steps` = 0 the value jumps from `start` to `end` at step `delay`.
    """

    start: float
    end: float
    steps: Steps
    delay: Steps = 0

    def __call__(self, step: int) -> float:
        if step < self.delay:
            return float(self.start)
        if step >= self.delay + self.steps:
            return float(self.end)
        return self._between((step - self.delay) / self.steps)

    @abstractmethod
    def _between(self, progress: float) -> float:
        """The value at a share `progress` in [0, 1) of the way."""


@dataclass(frozen=True)
class Linear(_Ramp):
    """A straight line from `start` to `end`."""

    def _between(self, progress: float) -> float:
        return self.start + (self.end - self.start) * progress


@dataclass(frozen=True)
class Cosine(_Ramp):
    """Half a cosine from `start` to `end`: flat at both ends."""

    def _between(self, progress: float) -> float:
        return self.end + (self.start - self.end) * 0.5 * (1.0 + math.cos(math.pi * progress))


@dataclass(frozen=True)
class Exponential(_Ramp):
    """A straight line in the logarithm from `start` to `end`; both must be positive."""

    def __post_init__(self) -> None:
        if self.start <= 0 or self.end <= 0:
            raise ValueError(f"start = {self.start} and end = {self.end} must both be above 0")

    def _between(self, progress: float) -> float:
        return self.start * (self.end / self.start) ** progress


@dataclass(frozen=True)
class Piecewise(Schedule):
    """Straight lines between knots (steps[i], values[i]); constant before the first and after the last."""

    steps: list[Steps]
    values: list[float]

    def __post_init__(self) -> None:
        if not self.steps or len(self.steps) != len(self.values):
            raise ValueError(f"steps has {len(self.steps)} entries, values {len(self.values)}: give one value per step")
        if any(a >= b for a, b in itertools.pairwise(self.steps)):
            raise ValueError(f"steps = {list(self.steps)} must increase from entry to entry")

    def __call__(self, step: int) -> float:
        if step <= self.steps[0]:
            return float(self.values[0])
        for i in range(1, len(self.steps)):
            if step < self.steps[i]:
                share = (step - self.steps[i - 1]) / (self.steps[i] - self.steps[i - 1])
                return self.values[i - 1] + (self.values[i] - self.values[i - 1]) * share
        return float(self.values[-1])


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


@dataclass(frozen=True)
class Staircase(Schedule):
    """values[i], where i milestones lie before the step: the value changes at the step after a milestone."""

    values: list[float]
    milestones: list[Steps]

    def __post_init__(self) -> None:
        if len(self.values) != len(self.milestones) + 1:
            raise ValueError(
                f"values has {len(self.values)} entries, milestones {len(self.milestones)}: give one more value than "
                "milestones"
            )
        if any(a >= b for a, b in itertools.pairwise(self.milestones)):
            raise ValueError(f"milestones = {list(self.milestones)} must increase from entry to entry")

    def __call__(self, step: int) -> float:
        return float(self.values[sum(step > milestone for milestone in self.milestones)])


@dataclass(frozen=True)
class Curriculum(Schedule):
    """A whole number drawn anew for every step, uniform from 1 to a largest one.

    The largest is 1 up to `delay` and grows by 1 every `every` steps after it.

    Args:
        every: steps.
        delay: steps.
        seed: of the draws; a number depends on it and on the step alone.
    """

    every: Annotated[int, Field(gt=0)]
    delay: Steps = 0
    seed: Annotated[int, Field(ge=0)] = 0

    def __call__(self, step: int) -> float:
        largest = 1 + max(0, step - self.delay) // self.every
        return float(1 + mixed(self.seed, step) % largest)
