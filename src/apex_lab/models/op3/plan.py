"""Which steps a clip takes and how much each of them counts (op3.md section 6).

The published code calls this a schedule; here that word is taken (`Context.schedule`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

Weighting = Literal["segment", "linear"]
Kind = Literal["refine", "dynamics"]


@dataclass(frozen=True)
class PlannedStep:
    """One step: what is done, on which frame it is scored, and the weight of its loss."""

    kind: Kind
    frame: int
    weight: float


@dataclass(frozen=True)
class Plan:
    """`first` refinements of the first frame, then one dynamics step and `later` refinements for every later frame.

    Args:
        first: refinements of a video's first frame.
        later: refinements of each other frame; 0 leaves prediction alone.
        weighting: `segment` (video benchmark): 1 for a dynamics step, j/n for the j-th of the n refinements of a
            frame. `linear` (official code): 1, 2, 3, ... over all steps.
    """

    first: Annotated[int, Field(gt=0)]
    later: Annotated[int, Field(ge=0)]
    weighting: Weighting

    def steps(self, frames: int, before: int = 0) -> list[PlannedStep]:
        """The steps of `frames` frames, the first of which has `before` frames before it in its video."""
        planned: list[PlannedStep] = []
        done = 0 if before == 0 else self.first + (before - 1) * (1 + self.later)
        for frame in range(frames):
            starts = before + frame == 0
            refinements = self.first if starts else self.later
            kinds: list[tuple[Kind, float]] = [] if starts else [("dynamics", 1.0)]
            kinds += [("refine", (j + 1) / refinements) for j in range(refinements)]
            for kind, share in kinds:
                done += 1
                planned.append(PlannedStep(kind, frame, share if self.weighting == "segment" else float(done)))
        return planned
