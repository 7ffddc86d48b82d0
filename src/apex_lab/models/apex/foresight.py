"""What chance decides about a pass before any network has run, so that a CPU leaves out what nobody will see.

Which videos carry their objects on and which may discover (`loop.carries_on`, `loop.may_discover`) are draws alone.
So all of a pass's numbers are drawn at its start, in the order and layout in which the networks ask for them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from apex_lab.nn.slots import NoiseOfSome
from apex_lab.scene import Noise, Schedule

Kind = Literal["normal", "uniform"]


class Foreseen(Noise):
    """Numbers drawn ahead, given out in the same order.

    Args:
        noise: where they come from.
        asked: kind and a tensor in the shape of each draw.
    """

    def __init__(self, noise: Noise, asked: Sequence[tuple[Kind, Tensor]]) -> None:
        self.drawn = [getattr(noise, kind)(like) for kind, like in asked]
        self._left = deque(self.drawn)

    def normal(self, like: Tensor) -> Tensor:
        return self._next(like)

    def uniform(self, like: Tensor) -> Tensor:
        return self._next(like)

    def _next(self, like: Tensor) -> Tensor:
        drawn = self._left.popleft()
        assert drawn.shape == like.shape
        return drawn


class NoiseOfFrames(NoiseOfSome):
    """Noise of some of F frames; first dimension F, or F and what follows.

    Args:
        noise: for all frames.
        frames: which are worked on.
        total: F.
    """

    def __init__(self, noise: Noise, frames: Int[Tensor, " N"], total: int) -> None:
        self._noise, self._frames, self._total = noise, frames, total

    def _whole(self, like: Tensor) -> Tensor:
        return like.new_empty(len(like) // len(self._frames) * self._total, *like.shape[1:])

    def _some(self, drawn: Tensor) -> Tensor:
        return drawn.unflatten(0, (self._total, -1)).index_select(0, self._frames).flatten(0, 1)


class Plan(NamedTuple):
    """What a pass works on.

    noise: for discovery and the loop over time. opened: frames (b T + t) in which discovery may find something; None:
    all. hidden (B, T): whether something may also be hidden there by an object that was carried on; None: everywhere.
    """

    noise: Noise | None
    opened: Int[Tensor, " M"] | None = None
    hidden: Bool[Tensor, "B T"] | None = None


def planned(
    noise: Noise,
    carried: Bool[Tensor, "B 1"],
    frames: int,
    sizes: tuple[int, int, int],
    schedule: Schedule,
    like: Tensor,
) -> Plan:
    """Draws the numbers of a pass in training.

    Args:
        noise: as the model is given it.
        carried: `Memory.carried_on` before the first frame.
        frames: T.
        sizes: D cells, P slots, Z.
        schedule: `carry` and `discover`.
        like: of the type and device of all numbers.
    """
    b, (cells, slots, what) = len(carried), sizes

    def shape(*size: int) -> Tensor:
        return like.new_empty(size)

    asked: list[tuple[Kind, Tensor]] = [
        ("normal", shape(b * frames, 4, cells).transpose(1, 2)),
        ("normal", shape(b * frames * cells, what)),
    ]
    for _ in range(frames):
        asked += [("normal", shape(b, slots, 4)), ("normal", shape(b, slots, what)), ("uniform", shape(b, slots))]
        asked += [("uniform", carried.float()), ("uniform", shape(b, cells)), ("uniform", carried.float())]
    foreseen = Foreseen(noise, asked)
    discovers, carries = (torch.cat(foreseen.drawn[2 + i :: 6], dim=1) for i in (3, 5))
    carried = torch.cat([carried, carries[:, :-1] < schedule["carry"]], dim=1)
    opened = ~carried | (discovers < schedule["discover"])
    some = bool(opened.any()) and not bool(opened.all())
    return Plan(foreseen, opened.flatten().nonzero().squeeze(1) if some else None, carried & opened)
