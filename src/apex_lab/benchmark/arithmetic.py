"""How near a step comes to what the device can compute: FLOPs by part, against the rate of a plain matrix product.

FLOPs are those of matrix products and convolutions, a multiplication and an addition each one (`torch.utils
.flop_counter`); element-wise work counts nothing. So a part's share of the rate is below 1, and what is missing is time
for memory, for element-wise work, for Python, and for products that are too small or too thin to run at the full rate.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from apex_lab.benchmark.profile import REST

SIDE = {"cpu": 1024, "cuda": 8192}
"""Rows of the square matrices that the rate is measured with."""


@dataclass
class Work:
    """What was done in a part: FLOPs, and seconds of all of the processor's threads together."""

    flops: int = 0
    seconds: float = 0.0


class Counted(TorchDispatchMode):
    """Counts what is done while it is active, by the ranges of `record_function`; inner ranges by themselves."""

    def __init__(self) -> None:
        super().__init__()
        self.parts: dict[str, Work] = {}
        self._inside = [REST]
        self._since = time.process_time()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if (name := func.name()).startswith("profiler::_record_function_"):
            self.settle()
            if "enter" in name:
                self._inside.append(args[0] if "::" not in args[0] and "#" not in args[0] else self._inside[-1])
            else:
                self._inside.pop()
            return func(*args, **kwargs)
        found = NotImplemented
        if func._overloadpacket not in flop_registry:
            with self:  # an operation that is made of others, as some are in inference
                found = func.decompose(*args, **kwargs)
        if found is NotImplemented:
            found = func(*args, **kwargs)
        if (flops := flop_registry.get(func._overloadpacket)) is not None:
            self._part().flops += flops(*args, **kwargs, out_val=found)
        return found

    def _part(self) -> Work:
        return self.parts.setdefault(self._inside[-1], Work())

    def settle(self) -> None:
        """Writes down the time that has passed in the innermost range."""
        now = time.process_time()
        self._part().seconds += now - self._since
        self._since = now


def counted_by_part(step: Callable[[], object]) -> dict[str, Work]:
    """Runs one step and counts."""
    with Counted() as counted:
        step()
    counted.settle()
    return counted.parts


def matrix_rate(device: torch.device, repeats: int = 5) -> float:
    """FLOP/s of a float32 product of two large square matrices; on a CPU of a processor's second."""
    n = SIDE[device.type]
    left, right = (torch.rand(n, n, device=device) for _ in range(2))
    clock = time.process_time if device.type == "cpu" else time.perf_counter
    seconds = []
    for _ in range(1 + repeats):
        _wait(device)
        began = clock()
        left @ right
        _wait(device)
        seconds.append(clock() - began)
    return 2 * n**3 / min(seconds)


def shares(step: Callable[[], object], device: torch.device, seconds: Mapping[str, float]) -> dict[str, Any]:
    """FLOPs of each part of a step, and which share of `matrix_rate` the part runs at.

    Args:
        step: with parts marked by `record_function`.
        seconds: of the parts, for a GPU; on a CPU the processor's time is taken here, which other programs do not
            lengthen.
    """
    rate = matrix_rate(device)
    parts = counted_by_part(step)
    taken = {name: work.seconds if device.type == "cpu" else seconds.get(name, 0.0) for name, work in parts.items()}
    total = sum(taken.values())
    return {
        "matrix_rate": rate,
        "flops": {name: work.flops for name, work in parts.items()},
        "counted_seconds": taken,
        "shares": {name: work.flops / (rate * max(taken[name], 1e-9)) for name, work in parts.items()},
        "share": sum(work.flops for work in parts.values()) / (rate * max(total, 1e-9)),
    }


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
