"""Objects carried from frame to frame: which are kept, in which slot, under which id (scalor.md section 9)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from apex_lab.nn.slots import gather_slots
from apex_lab.scene import ABSENT

FIRST_ID = 1


class Objects(NamedTuple):
    """Latents and recurrent states of K objects of a frame, each (B, K, ...).

    what (Z), where (4), raw (4): z_what, z_where, and the raw sample that z_where was made from (zeros for objects that
    were just discovered); depth (1); presence (1): z_pres.
    tracker (128): hidden state of the tracker. prior_h, prior_c (64): of the prior's LSTM.
    absence (1): how much of the object has been absent over its life.
    """

    what: Tensor
    where: Tensor
    raw: Tensor
    depth: Tensor
    presence: Tensor
    tracker: Tensor
    prior_h: Tensor
    prior_c: Tensor
    absence: Tensor

    @staticmethod
    def found(what: Tensor, where: Tensor, depth: Tensor, presence: Tensor, hidden: int, hidden_prior: int) -> Objects:
        """Objects that were just discovered: raw where, recurrent states and absence start at zero."""

        def zeros(n: int) -> Tensor:
            return what.new_zeros(*what.shape[:2], n)

        return Objects(
            what, where, zeros(4), depth, presence, zeros(hidden), zeros(hidden_prior), zeros(hidden_prior), zeros(1)
        )


class Slots(NamedTuple):
    """The P slots after a frame: what the next frame starts from.

    objects: zero where not valid. valid (B, P): the slot holds an object; the first ones do. ids (B, P): `ABSENT` where
    not valid. next_id (B,): the id that the video's next new object gets.
    """

    objects: Objects
    valid: Bool[Tensor, "B P"]
    ids: Int[Tensor, "B P"]
    next_id: Int[Tensor, " B"]


class Kept(NamedTuple):
    """Which of the P + D candidates of a frame its P slots hold.

    source (B, P): index of the candidate (arbitrary where not valid); valid, ids, next_id: as in `Slots`.
    """

    source: Int[Tensor, "B P"]
    valid: Bool[Tensor, "B P"]
    ids: Int[Tensor, "B P"]
    next_id: Int[Tensor, " B"]


def strongest(presence: Float[Tensor, "B D"], count: Int[Tensor, " B"]) -> Bool[Tensor, "B D"]:
    """Cells with a presence strictly above the (count + 1)-th largest of their video; all where D <= `count`.

    Of cells that tie for the last place none is taken, as published (training's cap on new objects).
    """
    d = presence.shape[1]
    ranked = presence.sort(dim=1, descending=True).values
    limit = ranked.gather(1, count.clamp(0, d - 1)[:, None])
    return (presence > limit) | (count >= d)[:, None]


def admitted(
    arrives: Bool[Tensor, "B D"], presence: Float[Tensor, "B D"], free: Int[Tensor, " B"]
) -> Bool[Tensor, "B D"]:
    """The arriving cells that find a slot: the `free` strongest; of equally strong ones the first, row by row.

    The original has no limit in evaluation. Here slots are limited, so where one is missing, what is least surely an
    object goes without, not what stands in the last rows of the image.
    """
    score = presence.masked_fill(~arrives, -torch.inf)
    rank = score.argsort(dim=1, descending=True, stable=True).argsort(dim=1)
    return arrives & (rank < free[:, None])


def pack(chosen: Bool[Tensor, "B K"], slots: int) -> tuple[Int[Tensor, "B P"], Bool[Tensor, "B P"]]:
    """Indices of the first `slots` chosen candidates, in order, and which of them there are (the first ones).

    Where there is none the index is arbitrary.
    """
    place = chosen.cumsum(1) - 1
    place = torch.where(chosen & (place < slots), place, slots)  # column `slots` takes all others
    candidate = torch.arange(chosen.shape[1], device=chosen.device).expand_as(place)
    source = place.new_zeros(len(place), slots + 1).scatter(1, place, candidate)[:, :slots]
    valid = torch.arange(slots, device=chosen.device) < chosen.sum(1, keepdim=True)
    return source, valid


def keep(
    stays: Bool[Tensor, "B P"],
    arrives: Bool[Tensor, "B D"],
    ids: Int[Tensor, "B P"],
    next_id: Int[Tensor, " B"],
) -> Kept:
    """Packs the kept objects to the front: propagated ones first, then cells row by row. No id comes back.

    Args:
        stays: propagated objects that are kept.
        arrives: discovered cells that become objects. Those that find no slot are dropped: see `admitted`.
        ids: of the propagated objects.
        next_id: per video.
    """
    source, valid = pack(torch.cat([stays, arrives], dim=1), ids.shape[1])
    fresh = next_id[:, None] + arrives.cumsum(1) - 1
    given = torch.cat([ids, fresh], dim=1).gather(1, source)
    return Kept(source, valid, given.masked_fill(~valid, ABSENT), next_id + arrives.sum(1))


def carry(candidates: tuple[Objects, Objects], kept: Kept, flow: Float[Tensor, ""]) -> Objects:
    """The kept objects in their slots, zero where there is none.

    Args:
        candidates: propagated objects, then discovered ones.
        kept: which.
        flow: above 1/2, gradients flow from frame to frame through the slots; else they stop here.
    """
    sizes = [x.shape[-1] for x in candidates[0]]
    whole = torch.cat([torch.cat(group, dim=-1) for group in candidates], dim=1)
    picked = gather_slots(whole, kept.source) * kept.valid[..., None]
    picked = torch.where(flow > 0.5, picked, picked.detach())
    return Objects(*picked.split(sizes, dim=-1))
