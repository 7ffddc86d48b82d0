"""States of models as plain tensors, and back."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from apex_lab.config.building import build_model, build_schedules
from apex_lab.inference.state import leaves, refilled
from apex_lab.nn.noise import VideoNoise
from apex_lab.scene import Context, Scene, Statistics, schedule_at
from tests.conftest import compose_job

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


@pytest.mark.slow
@pytest.mark.parametrize("model", ["apex", "op3", "scalor", "gswm", "background_subtraction"])
def test_every_model_that_streams_continues_from_stored_values(model: str) -> None:
    job = compose_job(f"model={model}", "data=sprites")
    made = build_model(job.config)
    schedule = schedule_at({name: float(each(0)) for name, each in build_schedules(job.config).items()})
    side = job.config.data["image_size"]
    made.initialise(Statistics(lambda: torch.full((3, side, side), 0.5)))
    made.eval()
    height, width = made.input_size or (side, side)
    video = torch.rand(1, 5, 3, height, width, generator=torch.Generator().manual_seed(0))

    def scene(frames: Tensor, first: int, before: Any = None) -> Scene:
        with torch.no_grad():
            return made(frames, Context(schedule, VideoNoise(0, [1], first), before))

    state = scene(video[:, :3], 0).state
    template = scene(torch.zeros_like(video[:, :1]), 0).state
    stored = io.BytesIO()
    torch.save(leaves(state), stored)
    stored.seek(0)
    again = refilled(template, torch.load(stored, weights_only=True), CPU)
    found, wanted = scene(video[:, 3:], 3, again), scene(video[:, 3:], 3, state)
    assert torch.equal(found.masks, wanted.masks)
    assert torch.equal(found.ids, wanted.ids)
