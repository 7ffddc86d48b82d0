"""Which objects are kept, in which slot, under which identity (gswm.md sections 8 and 9).

The published code sorts slots by presence in every frame and takes new identities from the largest one still kept, so
that a lost object's identity can come back. Neither changes what is inferred, so here an object keeps its slot, and
identities are never given twice.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from apex_lab.nn.slots import gather_slots

FIRST_ID = 1

take = gather_slots


class Kept(NamedTuple):
    """source (B, M): index among the D cells, then the M slots, of what each slot holds now; ids (B, M)."""

    source: Int[Tensor, "B M"]
    ids: Int[Tensor, "B M"]


def keep(
    found: Float[Tensor, "B D"],
    tracked: Float[Tensor, "B M"] | None,
    ids: Int[Tensor, "B M"] | None,
    next_id: Int[Tensor, " B"],
    slots: int,
    discovers: Bool[Tensor, " B"] | None,
) -> Kept:
    """Keeps the most present ones of discovered and tracked objects; on ties discovered ones come first.

    A tracked object that is kept stays in its slot, new ones fill the free slots, the most present first.

    Args:
        found: presence of the cells' objects.
        tracked, ids: presence and identities of the slots; None in a video's first frame.
        next_id: identity of the first cell's object; the others count on from it.
        slots: M, at most D.
        discovers: videos that may discover in this frame; None: all.
    """
    found = found.detach()
    if discovers is not None:
        found = torch.where(discovers[:, None], found, -1.0)
    best = found.argsort(dim=1, descending=True, stable=True)[:, :slots]
    if tracked is None or ids is None:
        return Kept(best, next_id[:, None] + best)
    d = found.shape[1]
    order = torch.cat([found, tracked.detach()], dim=1).argsort(dim=1, descending=True, stable=True)
    chosen = torch.zeros_like(order, dtype=torch.bool).scatter(1, order[:, :slots], True)
    stays = chosen[:, d:]
    rank = ((~stays).cumsum(1) - 1).clamp_min(0)  # the i-th free slot takes the i-th best new object
    fresh = best.gather(1, rank)
    own = torch.arange(d, d + slots, device=ids.device)
    return Kept(torch.where(stays, own, fresh), torch.where(stays, ids, next_id[:, None] + fresh))
