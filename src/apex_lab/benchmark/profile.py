"""Seconds by part of a step: ranges that models and the step mark with `torch.profiler.record_function`.

A part's time is that between its begin and end without the parts inside it, so the seconds of all parts add up to the
whole. Profiling makes a step slower; shares are what to read.
"""

from __future__ import annotations

import os
from collections.abc import Callable
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
        device: the ranges' time on CUDA is that of the kernels that they launch.
    """
    if device.type == "cpu":  # the profiler tells of its own begin and end; on a GPU also of what is wrong with CUPTI
        os.environ.setdefault("KINETO_LOG_LEVEL", "6")
    activities = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if device.type == "cuda" else [])]
    with profile(activities=activities, acc_events=True) as profiled, record_function(WHOLE):
        step()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
    events = [event for event in profiled.events() if _is_part(event)]
    seconds: dict[str, float] = {}
    for event in events:
        inside = sum(_seconds(other, device) for other in events if _parent_of(other, events) is event)
        name = REST if event.name == WHOLE else event.name
        seconds[name] = seconds.get(name, 0.0) + max(_seconds(event, device) - inside, 0.0)
    return seconds


def _is_part(event: Any) -> bool:
    return bool(event.is_user_annotation) and "#" not in event.name and "::" not in event.name


def _seconds(event: Any, device: torch.device) -> float:
    total = event.device_time_total if device.type == "cuda" else event.cpu_time_total
    return float(total) / 1e6


def _parent_of(event: Any, events: list[Any]) -> Any:
    """The innermost part around an event of the same thread."""
    around = [
        other
        for other in events
        if other is not event
        and other.thread == event.thread
        and other.time_range.start <= event.time_range.start
        and event.time_range.end <= other.time_range.end
    ]
    return min(around, key=lambda other: other.time_range.elapsed_us(), default=None)
