"""Object filtering and identities: which objects are carried on, in which slot, under which id (apex.md, step 6).

Shapes never change: P slots and N candidates with validity masks, top-k instead of lists, no data-dependent branch.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from apex_lab.nn.slots import gather_slots as gather_slots


class Carried(NamedTuple):
    """What the P slots hold after filtering.

    source: (B, P) index into the P + N candidates each slot's content comes from (arbitrary where not valid).
    valid: (B, P) the slot holds an object.
    ids: (B, P) identities; -1 where not valid.
    next_id: (B,) the identity that the video's next new object will get.
    """

    source: Tensor
    valid: Tensor
    ids: Tensor
    next_id: Tensor


def carry(
    presence: Float[Tensor, "B P_plus_N"],
    valid: Bool[Tensor, "B P_plus_N"],
    ids: Int[Tensor, "B P"],
    next_id: Int[Tensor, " B"],
    threshold: float,
) -> Carried:
    """Drops objects with a presence below the threshold and carries on the P strongest.

    A propagated object that stays keeps its slot and its id. New objects fill the free slots, strongest first, and get
    the next ids of their video in that order; an id never comes back.

    Args:
        presence: of the P propagated objects, then of the N discovered ones.
        valid: False for slots that hold nothing.
        ids: of the P propagated objects.
        next_id: per video.
        threshold: manually set presence threshold, in (0, 1).
    """
    slots = ids.shape[1]
    score = torch.where(valid & (presence >= threshold), presence, -torch.ones_like(presence)).detach()
    # A stable sort: of two equally strong objects the earlier one stays, on every device.
    order = score.argsort(dim=1, descending=True, stable=True)
    chosen = torch.zeros_like(valid).scatter(1, order[:, :slots], True) & (score > 0)
    stays, fresh = chosen[:, :slots], chosen[:, slots:]

    fresh_score = torch.where(fresh, score[:, slots:], -torch.ones_like(score[:, slots:]))
    newcomers = fresh_score.argsort(dim=1, descending=True, stable=True)
    arrivals = fresh.sum(1)
    rank = (~stays).cumsum(1) - 1  # index among the free slots
    fills = ~stays & (rank < arrivals[:, None])
    picked = newcomers.gather(1, rank.clamp(0, newcomers.shape[1] - 1))
    source = torch.where(fills, slots + picked, torch.arange(slots, device=ids.device).expand_as(ids))
    new_ids = torch.where(fills, next_id[:, None] + rank, torch.where(stays, ids, torch.full_like(ids, -1)))
    return Carried(source, stays | fills, new_ids, next_id + arrivals)
