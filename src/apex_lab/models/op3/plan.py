"""Which steps a clip takes and how much each of them counts (op3.md section 6).

The published code calls this a schedule; in this package that word also names values that change during training
(`Context.schedule`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

ScheduleKind = Literal["rprp", "single_step_physics", "curriculum"]
Weighting = Literal["segment", "linear"]
Kind = Literal["refine", "dynamics"]

REFINE: Kind = "refine"
DYNAMICS: Kind = "dynamics"


class Listed(NamedTuple):
    """A schedule written out.

    Attributes:
        kinds: of the steps.
        weights: of the steps' losses.
        readout: for each frame that is reached, the index of its last step, after which its masks are read.
    """

    kinds: list[Kind]
    weights: list[float]
    readout: list[int]


@dataclass(frozen=True)
class PlannedStep:
    """One step: what is done, on which frame it is scored, and the weight of its loss."""

    kind: Kind
    frame: int
    weight: float


def listed(
    schedule: ScheduleKind,
    first: int,
    later: int,
    length: int,
    weighting: Weighting,
    available: int | None = None,
    predictions: int = 1,
) -> Listed:
    """A published schedule, written out.

    Args:
        schedule: `rprp`: refinements of the first frame, then a dynamics step and refinements for every later one.
            `single_step_physics`: refinements, then dynamics to the end. `curriculum`: refinements, `predictions`
            dynamics steps, one refinement.
        first: refinements of the first frame.
        later: refinements of each other frame (`rprp` alone).
        length: frames of `rprp`, steps of `single_step_physics`; not read by `curriculum`.
        weighting: as of `Plan`.
        available: frames that there are: no more dynamics steps than lead to the last of them, refinements in the
            place of others. None: enough.
        predictions: dynamics steps of `curriculum`.
    """
    kinds: list[Kind]
    if schedule == "rprp":
        kinds = _frame_by_frame(first, later, length)
    elif schedule == "single_step_physics":
        kinds = [REFINE] * min(first, length) + [DYNAMICS] * (length - first)
    else:
        kinds = [REFINE] * first + [DYNAMICS] * predictions + [REFINE]
    kinds = kinds if available is None else _capped(kinds, available)
    return Listed(kinds, _weights(kinds, weighting), _readout(kinds))


def _frame_by_frame(first: int, later: int, frames: int, starts: bool = True) -> list[Kind]:
    """The steps of `rprp` for some frames, the first of which is the video's first or not."""
    kinds: list[Kind] = []
    for frame in range(frames):
        kinds += [REFINE] * first if starts and frame == 0 else [DYNAMICS, *[REFINE] * later]
    return kinds


def _capped(kinds: list[Kind], available: int) -> list[Kind]:
    """Refinements in place of the dynamics steps beyond the last frame."""
    found: list[Kind] = []
    for kind in kinds:
        found.append(REFINE if found.count(DYNAMICS) >= available - 1 else kind)
    return found


def _weights(kinds: list[Kind], weighting: Weighting, before: int = 0) -> list[float]:
    """Weights of the steps' losses; `before` is the number of steps before these."""
    if weighting == "linear":
        return [float(before + i + 1) for i in range(len(kinds))]
    weights: list[float] = []
    for part in _segments(kinds):
        weights += [(j + 1) / len(part) if kind == REFINE else 1.0 for j, kind in enumerate(part)]
    return weights


def _segments(kinds: list[Kind]) -> list[list[Kind]]:
    """Runs of refinements, and dynamics steps one by one."""
    segments: list[list[Kind]] = []
    for kind in kinds:
        if kind == REFINE and segments and segments[-1][0] == REFINE:
            segments[-1].append(kind)
        else:
            segments.append([kind])
    return segments


def _readout(kinds: list[Kind]) -> list[int]:
    """The step before each dynamics step, and the last."""
    return [i for i in range(len(kinds)) if i + 1 == len(kinds) or kinds[i + 1] == DYNAMICS]


@dataclass(frozen=True)
class Plan:
    """The steps of a clip in training and of a video in evaluation.

    Args:
        first: refinements of a video's first frame.
        later: refinements of each other frame; 0 leaves prediction alone.
        weighting: `segment` (video benchmark): 1 for a dynamics step, j/n for the j-th of n refinements in a row.
            `linear` (official code): 1, 2, 3, ... over all steps.
        schedule: of training, as of `listed`. Evaluation is always `rprp`, which looks at every frame.
    """

    first: Annotated[int, Field(gt=0)]
    later: Annotated[int, Field(ge=0)]
    weighting: Weighting
    schedule: ScheduleKind = "rprp"

    def steps(self, frames: int, before: int = 0) -> list[PlannedStep]:
        """The steps of `rprp` for `frames` frames, the first of which has `before` frames before it in its video."""
        kinds = _frame_by_frame(self.first, self.later, frames, starts=before == 0)
        done = 0 if before == 0 else self.first + (before - 1) * (1 + self.later)
        return _placed(kinds, _weights(kinds, self.weighting, done), frame=0 if before == 0 else -1)

    def training_steps(self, frames: int, predictions: int = 1) -> list[PlannedStep]:
        """The steps of the schedule for a clip; frames that it does not reach are predicted, with a weight of 0.

        Args:
            frames: of the clip.
            predictions: as of `listed`.
        """
        length = self.first + frames - 1 if self.schedule == "single_step_physics" else frames
        found = listed(self.schedule, self.first, self.later, length, self.weighting, frames, predictions)
        steps = _placed(found.kinds, found.weights)
        return steps + [PlannedStep(DYNAMICS, frame, 0.0) for frame in range(len(found.readout), frames)]


def _placed(kinds: list[Kind], weights: list[float], frame: int = 0) -> list[PlannedStep]:
    """Steps with the frames that they are scored on: a dynamics step goes to the next one, from `frame` on."""
    steps: list[PlannedStep] = []
    for kind, weight in zip(kinds, weights, strict=True):
        frame += kind == DYNAMICS
        steps.append(PlannedStep(kind, frame, weight))
    return steps
