"""A schedule in stairs: for clip lengths, which are whole numbers."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from apex_lab.schedules import Schedule, Steps


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
