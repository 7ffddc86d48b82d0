"""States of models as plain tensors, and back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from apex_lab.inference.state import leaves, refilled

CPU = torch.device("cpu")


class Pair(NamedTuple):
    first: Tensor
    rest: Any


@dataclass(frozen=True)
class Held:
    masks: np.ndarray
    free: int


def state(size: int, number: int) -> Any:
    return Pair(torch.full((size,), float(number)), [{"a": Held(np.full(size, number), number), "b": None}, (True,)])


def test_another_state_fits_into_the_structure() -> None:
    found = refilled(state(2, 1), leaves(state(5, 7)), CPU)
    assert isinstance(found, Pair)
    assert torch.equal(found.first, torch.full((5,), 7.0))
    held = found.rest[0]["a"]
    assert isinstance(held, Held)
    assert (held.free, held.masks.tolist()) == (7, [7] * 5)
    assert found.rest[0]["b"] is None
    assert found.rest[1] == (True,)
    assert refilled(None, leaves(None), CPU) is None


def test_values_that_do_not_fit_are_refused() -> None:
    for wrong in (leaves(state(2, 1))[:-1], [*leaves(state(2, 1)), 3], [None, *leaves(state(2, 1))[1:]]):
        with pytest.raises(ValueError, match="place"):
            refilled(state(2, 1), wrong, CPU)
    with pytest.raises(TypeError, match="a state may not hold set"):
        leaves({1, 2})
