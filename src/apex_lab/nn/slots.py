"""Objects in slots."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from apex_lab.scene import Noise


def gather_slots(values: Tensor, source: Int[Tensor, "*batch S"], dim: int = 1) -> Tensor:
    """Values whose K objects lie along `dim`, taken at `source` -> S objects there.

    The other dimensions of `source` are those of `values` before `dim`: values (B, K, ...) and source (B, S), or, with
    `dim` = 2, values (2, B, K, ...) and source (B, S), or values (B, T, K, ...) and source (B, T, S).
    """
    shape, size = [1] * values.dim(), list(values.shape)
    shape[dim + 1 - source.dim() : dim + 1] = source.shape
    size[dim] = source.shape[-1]
    return values.gather(dim, source.view(shape).expand(size))


def leading(valid: Bool[Tensor, "*batch P"]) -> int:
    """How many leading slots to work on, where the valid ones come first: at least 1; no valid one is left out.

    On a CPU as many as the fullest row has. A GPU would have to wait for that number, and a CUDA graph or a compiler
    takes one shape only, so there it is all.
    """
    slots = valid.shape[-1]
    if valid.device.type != "cpu" or torch.compiler.is_compiling():
        return slots
    return max(1, int(valid.sum(-1).max()))


def padded(values: Float[Tensor, "B n ..."], slots: int) -> Float[Tensor, "B P ..."]:
    """Values of the leading slots -> of all, zero behind them."""
    b, n = values.shape[:2]
    if n == slots:
        return values
    return torch.cat([values, values.new_zeros(b, slots - n, *values.shape[2:])], dim=1)


def may_look(values: Tensor) -> bool:
    """Whether work may depend on the numbers in a tensor: on a CPU, in one precision.

    A GPU would have to wait for them, a CUDA graph or a compiler takes one course only, and in mixed precision the
    types of what is left out, which noise is drawn in, would have to be guessed.
    """
    return values.device.type == "cpu" and not torch.compiler.is_compiling() and not torch.is_autocast_enabled("cpu")


def any_of(mask: Bool[Tensor, "..."]) -> bool:
    """Whether any is true; true where nobody may look."""
    return not may_look(mask) or bool(mask.any())


def none_of(values: Float[Tensor, "..."]) -> bool:
    """Whether all are zero; false where nobody may look."""
    return may_look(values) and not bool(values.any())


def filled(valid: Bool[Tensor, "B P"]) -> Int[Tensor, "B n"] | None:
    """The slots that hold something, filled up with empty ones to those of the fullest row, at least one.

    None for all slots, which it is where nobody may look.
    """
    if not may_look(valid):
        return None
    most = max(1, int(valid.sum(1).max()))
    return None if most == valid.shape[1] else filled_first(valid)[:, :most]


def filled_first(valid: Bool[Tensor, "B P"]) -> Int[Tensor, "B P"]:
    """All slots, those that hold something first; otherwise in order."""
    return (~valid).to(torch.uint8).argsort(dim=1, stable=True)


def inverse_of(slots: Int[Tensor, "B n"], total: int) -> Int[Tensor, "B P"]:
    """Where each of `total` slots stands in `slots`; 0 where it does not."""
    places = torch.arange(slots.shape[1], device=slots.device).expand_as(slots)
    return slots.new_zeros(len(slots), total).scatter(1, slots, places)


def gather_fields(fields: Sequence[Float[Tensor, "B K ..."]], source: Int[Tensor, "B S"]) -> list[Tensor]:
    """`gather_slots` of several tensors of one type, (B, K) or (B, K, C) each, in one operation for all."""
    widths = [field.shape[2] if field.dim() == 3 else 1 for field in fields]
    packed = torch.cat([field if field.dim() == 3 else field[..., None] for field in fields], dim=2)
    values = gather_slots(packed, source).split(widths, dim=2)
    return [x if field.dim() == 3 else x.squeeze(2) for x, field in zip(values, fields, strict=True)]


class NoiseOfSome(Noise, ABC):
    """Noise that is drawn for all, of whom some are worked on: each gets the numbers that it would get anyway."""

    _noise: Noise

    def normal(self, like: Tensor) -> Tensor:
        return self._some(self._noise.normal(self._whole(like)))

    def uniform(self, like: Tensor) -> Tensor:
        return self._some(self._noise.uniform(self._whole(like)))

    @abstractmethod
    def _whole(self, like: Tensor) -> Tensor:
        """An empty tensor for all, where `like` is for some."""

    @abstractmethod
    def _some(self, drawn: Tensor) -> Tensor:
        """The numbers of those that are worked on."""


class NoiseOfSlots(NoiseOfSome):
    """Noise of some slots.

    Args:
        noise: for all slots.
        slots: which are worked on.
        total: P.
    """

    def __init__(self, noise: Noise, slots: Int[Tensor, "B n"], total: int) -> None:
        self._noise, self._slots, self._total = noise, slots, total

    def _whole(self, like: Tensor) -> Tensor:
        return like.new_empty(len(like), self._total, *like.shape[2:])

    def _some(self, drawn: Tensor) -> Tensor:
        return gather_slots(drawn, self._slots)
