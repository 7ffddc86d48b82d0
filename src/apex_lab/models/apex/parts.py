"""Frames and components that are rendered together: on a CPU only what may be seen, in parts that fit its cache."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from apex_lab.nn.slots import filled_first, gather_slots, inverse_of, may_look
from apex_lab.nn.splitting import part_size


class Part(NamedTuple):
    """N of the F frames of all videos, and n of the R components of each, among them all that hold something.

    frames, slots: which; None: all, in order. places (N, R): where each component stands among the n; 0 where it does
    not.
    """

    frames: Int[Tensor, " N"] | None = None
    slots: Int[Tensor, "N n"] | None = None
    places: Int[Tensor, "N R"] | None = None

    def of_frames(self, values: Tensor) -> Tensor:
        """Values (F, ...) -> (N, ...)."""
        return values if self.frames is None else values.index_select(0, self.frames)

    def of_components(self, values: Tensor) -> Tensor:
        """Values (F, R, ...) -> (N, n, ...)."""
        if self.frames is None or self.slots is None:
            return values
        return _rows(values, self.frames, self.slots)

    def at(self, values: Tensor, source: Int[Tensor, "F P"]) -> Tensor:
        """Values (N, n, ...) -> (N, P, ...) of the components at `source`; arbitrary where nothing is held there."""
        if self.places is None:
            return gather_slots(values, source)
        here = self.places.gather(1, self.of_frames(source))
        return _rows(values, torch.arange(len(values), device=values.device), here)


def _rows(values: Tensor, frames: Int[Tensor, " N"], slots: Int[Tensor, "N n"]) -> Tensor:
    """Values (F, R, ...) of frames and some components of each -> (N, n, ...), copied as whole rows."""
    which = frames[:, None] * values.shape[1] + slots
    return values.flatten(0, 1).index_select(0, which.flatten()).unflatten(0, which.shape)


def parts_of(valid: Bool[Tensor, "F R"], values_each: int, like: Tensor) -> list[Part]:
    """All frames, the fullest first; a part has as many components as its first frame holds, and at least one.

    Args:
        valid: which components hold something.
        values_each: numbers that the largest tensor holds for a component.
        like: a tensor of the device and type that frames are rendered with.
    """
    if not may_look(valid):  # on a CPU in mixed precision, parts of all components would do; not worth a third way
        return [Part()]
    total, counts = valid.shape[1], valid.sum(1)
    order = counts.argsort(descending=True, stable=True)
    slots, numbers = filled_first(valid).index_select(0, order), counts[order].tolist()
    parts: list[Part] = []
    start = 0
    while start < len(numbers):
        most = max(1, numbers[start])
        end = start + part_size(len(numbers) - start, most * values_each, like)
        of_part = slots[start:end, :most]
        parts.append(Part(order[start:end], of_part, inverse_of(of_part, total)))
        start = end
    return parts


def in_order(parts: Sequence[Part], values: Sequence[Tensor]) -> Float[Tensor, "F ..."]:
    """Values (N, ...) of the frames of each part -> of all frames, in their order."""
    if parts[0].frames is None:
        return values[0]
    frames = torch.cat([part.frames for part in parts if part.frames is not None])
    return torch.cat(list(values)).index_select(0, frames.argsort())
