"""Seconds by part of a step: ranges that models and the step mark with `torch.profiler.record_function`.

On a CPU a part's time is that between its begin and end without the parts inside it, so the seconds of all parts add up
to the whole. On a GPU it is that of the kernels that were launched meanwhile, by whatever thread: autograd has its own
for the backward pass. Profiling makes a step slower; shares are what to read.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile, record_function

REST = "rest"
"""What belongs to no part."""

WHOLE = "step"


def seconds_by_part(step: Callable[[], object], device: torch.device) -> dict[str, float]:
    """Runs one step under the profiler.

    Args:
        step: with parts marked by `record_function`, whose names contain neither "::" nor "#".
        device: of the step.
    """
    if device.type == "cpu":  # the profiler tells of its own begin and end; on a GPU also of what is wrong with CUPTI
        os.environ.setdefault("KINETO_LOG_LEVEL", "6")
    activities = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if device.type == "cuda" else [])]
    with profile(activities=activities, acc_events=True) as profiled, record_function(WHOLE):
        step()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
    events = list(profiled.events())
    return _by_kernels(events) if device.type == "cuda" else _by_clock(events)


def _by_clock(events: Sequence[Any]) -> dict[str, float]:
    parts = [event for event in events if _is_part(event)]
    seconds: dict[str, float] = {}
    for part in parts:
        inside = sum(other.cpu_time_total for other in parts if _parent_of(other, parts) is part)
        seconds[_name(part)] = seconds.get(_name(part), 0.0) + max(part.cpu_time_total - inside, 0.0) / 1e6
    return seconds


def _by_kernels(events: Sequence[Any]) -> dict[str, float]:
    parts = [event for event in events if _is_part(event)]
    ranges = {event.name for event in events if event.is_user_annotation}  # the GPU's own copies of them are no kernels
    seconds = dict.fromkeys(map(_name, parts), 0.0)
    for event in events:
        took = sum(kernel.duration for kernel in event.kernels if kernel.name not in ranges)
        begun = event.time_range.start
        around = [part for part in parts if part.time_range.start <= begun <= part.time_range.end]
        if took and around:
            seconds[_name(min(around, key=_length))] += took / 1e6
    return seconds


def _name(part: Any) -> str:
    return REST if part.name == WHOLE else str(part.name)


def _length(part: Any) -> float:
    return float(part.time_range.elapsed_us())


def _is_part(event: Any) -> bool:
    """Whether an event is a range of the host's; a GPU has a copy of each range, around its kernels."""
    on_host = event.device_type == torch.autograd.DeviceType.CPU
    return bool(event.is_user_annotation) and on_host and "#" not in event.name and "::" not in event.name


def _parent_of(event: Any, events: Sequence[Any]) -> Any:
    """The innermost part around an event of the same thread."""
    around = [
        other
        for other in events
        if other is not event
        and other.thread == event.thread
        and other.time_range.start <= event.time_range.start
        and event.time_range.end <= other.time_range.end
    ]
    return min(around, key=_length, default=None)
