"""Seconds by part: a clock that stands beside a model, and where APEX's parts begin and end.

The model is not changed: while it is watched, its parts' entry points are replaced by ones that mark the time. Between
two marks exactly one part is at work, so the seconds of all parts add up to the whole.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

import torch

import apex_lab.models.apex.model as apex
from apex_lab.models.apex import Apex
from apex_lab.scene import SceneModel

REST = "rest"
"""What belongs to no part: making the batch, sums of terms, the result's tensors."""

PARTS = (
    "encoder",
    "propagation",
    "discovery",
    "filtering",
    "rendering",
    "likelihood",
    "other terms",
    "backward",
    "update",
    REST,
)
"""In the order of a step. `discovery` includes the context that scales proposals; `filtering` is the loop over time
apart from propagation and discovery; `rendering` decodes, pastes and normalises; `other terms` are the KL terms and the
mask entropy; `update` clips gradients and updates weights."""

Timed = Callable[[], Any]


class Clock:
    """Seconds of each part, without those of the parts inside it.

    Args:
        device: on CUDA time is taken by events in the stream, so watching makes nothing wait.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._open = [REST]
        self._marks: list[tuple[str, Any]] = []

    def _mark(self) -> None:
        if self._device.type == "cuda":
            at = torch.cuda.Event(enable_timing=True)
            at.record()
            self._marks.append((self._open[-1], at))
        else:
            self._marks.append((self._open[-1], time.perf_counter()))

    def start(self) -> None:
        """Begins anew, with the rest."""
        self._open, self._marks = [REST], []
        self._mark()

    @contextlib.contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Everything inside belongs to `name`, unless a part inside it says otherwise."""
        self._open.append(name)
        self._mark()
        try:
            yield
        finally:
            self._open.pop()
            self._mark()

    def stop(self) -> dict[str, float]:
        """Seconds of every part since `start`; waits for the device."""
        self._mark()
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        seconds: dict[str, float] = {}
        for (name, begin), (_, end) in zip(self._marks, self._marks[1:], strict=False):
            passed = begin.elapsed_time(end) / 1000 if self._device.type == "cuda" else end - begin
            seconds[name] = seconds.get(name, 0.0) + passed
        return seconds


@contextlib.contextmanager
def watched(model: SceneModel, clock: Clock) -> Iterator[None]:
    """While this lasts, the parts of an APEX model tell the clock when they work; other models have no parts."""
    entries = _entries(model) if isinstance(model, Apex) else []
    with contextlib.ExitStack() as stack:
        for owner, name, part in entries:
            stack.enter_context(_replaced(owner, name, _timed(getattr(owner, name), part, clock)))
        yield


def _entries(model: Apex) -> list[tuple[Any, str, str]]:
    """(owner, attribute, part) of every place where a part of APEX begins."""
    return [
        (model.encoder, "forward", "encoder"),
        (model.propagation, "forward", "propagation"),
        (model.discovery, "forward", "discovery"),
        (model.masks, "foreground", "discovery"),  # the scope that proposals are held against
        (model.masks, "claim", "discovery"),
        (apex, "context_probability", "discovery"),
        (apex, "scope_in_windows", "discovery"),
        (model, "_roll_out", "filtering"),
        (model, "_alpha", "rendering"),
        (model, "_explain", "rendering"),
        (model, "likelihood", "likelihood"),
        (apex, "kl_terms", "other terms"),
        (apex, "kl_gaussian", "other terms"),
        (apex, "mask_entropy", "other terms"),
        (apex, "scene_of", REST),
    ]


def _timed(function: Callable[..., Any], part: str, clock: Clock) -> Callable[..., Any]:
    def timed(*args: Any, **kwargs: Any) -> Any:
        with clock.part(part):
            return function(*args, **kwargs)

    return timed


@contextlib.contextmanager
def _replaced(owner: Any, name: str, value: object) -> Iterator[None]:
    """Puts an attribute in place and takes it away again, or back to what the owner itself had."""
    own = vars(owner)
    had, before = name in own, own.get(name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        if had:
            setattr(owner, name, before)
        else:
            delattr(owner, name)
