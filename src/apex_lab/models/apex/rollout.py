"""The loop over time: propagation, presence of discoveries, filtering, identities (apex.md, "Inference side")."""

from __future__ import annotations

from typing import NamedTuple, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from apex_lab.models.apex.objects import Beliefs


class Step(NamedTuple):
    """One frame as the loop leaves it, or, stacked along dimension 1, all frames of a video.

    P propagated slots and N rendered discoveries are the R = P + N components that explain the frame.

    what (B, R, Z), place (B, R, 4), alpha (B, R, g, g), presence (B, R): samples; presence is zero where not valid.
    valid (B, R): there is an object, and it is present.
    alive (B, P): the slot came into the frame with an object, whether or not it is still present.
    propagated: beliefs about the P slots.
    discovery_prob, discovery_prior, discovery_pres (B, D): q, p and sample of the presence of all D cells.
    source (B, P), carried (B, P), ids (B, P): what the slots hold after filtering, as in `slots.Carried`.
    """

    what: Tensor
    place: Tensor
    alpha: Tensor
    presence: Tensor
    valid: Bool[Tensor, "B R"]
    alive: Bool[Tensor, "B P"]
    propagated: Beliefs
    discovery_prob: Float[Tensor, "B D"]
    discovery_prior: Float[Tensor, "B D"]
    discovery_pres: Float[Tensor, "B D"]
    source: Int[Tensor, "B P"]
    carried: Bool[Tensor, "B P"]
    ids: Int[Tensor, "B P"]


def stack_steps(steps: list[Step]) -> Step:
    """Frames -> video: every tensor gets a time dimension at position 1."""

    def stacked(values: list[object]) -> object:
        first = values[0]
        if isinstance(first, Tensor):
            return torch.stack(cast(list[Tensor], values), dim=1)
        kind = type(first)
        assert isinstance(first, tuple)
        columns = zip(*cast(list[tuple[object, ...]], values), strict=True)
        return kind(*(stacked(list(column)) for column in columns))

    return cast(Step, stacked(list(steps)))
