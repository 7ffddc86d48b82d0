"""How near a step comes to what the device can compute: FLOPs by part, against the rate of a plain matrix product.

FLOPs are those of matrix products and convolutions, a multiplication and an addition each one (`torch.utils
.flop_counter`); element-wise work counts nothing. So a part's share of the rate is below 1, and what is missing is time
for memory, for element-wise work, for Python, and for products that are too small or too thin to run at the full rate.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch.profiler import record_function
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from apex_lab.benchmark.profile import REST

SIDE = {"cpu": 1024, "cuda": 8192}
"""Rows of the square matrices that the rate is measured with."""


class Counted(TorchDispatchMode):
    """Counts FLOPs while it is active, by the ranges of `record_function`; inner ranges by themselves."""

    def __init__(self) -> None:
        super().__init__()
        self.flops: Counter[str] = Counter()
        self._inside = [REST]

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if (name := func.name()).startswith("profiler::_record_function_"):
            if "enter" in name:
                self._inside.append(_range(args[0], self._inside))
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
            self.flops[self._inside[-1]] += flops(*args, **kwargs, out_val=found)
        return found


def _range(name: str, inside: Sequence[str]) -> str:
    """The part that a range belongs to: its own, or the one around it where PyTorch made the range itself."""
    return inside[-1] if "::" in name or "#" in name else name


def flops_by_part(step: Callable[[], object]) -> dict[str, int]:
    """Runs one step and counts; slower by some microseconds per operation, so nothing is timed here."""
    with Counted() as counted:
        step()
    return dict(counted.flops)


def processor_seconds(step: Callable[[], object]) -> dict[str, float]:
    """Runs one step; seconds of all of the processor's threads together by part, inner parts by themselves.

    The profiler's seconds are those of a clock, and it lengthens what it times. So enter and exit of `record_function`
    are replaced while the step runs, for the whole process: one thread, eager code.
    """
    seconds: dict[str, float] = {}
    inside, since = [REST], time.process_time()
    enter, leave = record_function.__enter__, record_function.__exit__

    def settle() -> None:
        nonlocal since
        now = time.process_time()
        seconds[inside[-1]] = seconds.get(inside[-1], 0.0) + now - since
        since = now

    def entered(this: record_function) -> record_function:
        settle()
        inside.append(_range(this.name, inside))
        return enter(this)

    def left(this: record_function, *error: Any) -> None:
        leave(this, *error)
        settle()
        inside.pop()

    record_function.__enter__ = entered  # type: ignore[method-assign]
    record_function.__exit__ = left  # type: ignore[method-assign]
    try:
        step()
    finally:
        record_function.__enter__ = enter  # type: ignore[method-assign]
        record_function.__exit__ = leave  # type: ignore[method-assign]
    settle()
    return seconds


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


def shares(
    step: Callable[[], object],
    device: torch.device,
    seconds: Mapping[str, float],
    rewound: Callable[[], AbstractContextManager[object]] = contextlib.nullcontext,
) -> dict[str, Any]:
    """FLOPs of each part of a step, and which share of `matrix_rate` the part runs at.

    On a CPU one step is made twice, as a model may leave out work by draws: it is counted, taken back, and timed. On a
    GPU, where nothing is left out, the seconds are given.

    Args:
        step: with parts marked by `record_function`.
        seconds: of the parts, for a GPU; on a CPU the processor's time is taken here, which waiting for other programs
            does not lengthen.
        rewound: a step made inside is taken back, so that the next one does the same work (`Workload.rewound`).

    Returns:
        `matrix_rate` in FLOP/s; by part `flops`, `counted_seconds` that they took, `rates` in FLOP/s, which are flops /
        counted_seconds, and `shares`, which are rates / matrix_rate; `rate` and `share` of all parts together.
    """
    matrix = matrix_rate(device)
    with rewound():
        counted = flops_by_part(step)
    taken = processor_seconds(step) if device.type == "cpu" else dict(seconds)
    flops = {name: counted.get(name, 0) for name in {**taken, **counted}}
    taken = {name: taken.get(name, 0.0) for name in flops}
    rates = {name: work / max(taken[name], 1e-9) for name, work in flops.items()}
    rate = sum(flops.values()) / max(sum(taken.values()), 1e-9)
    return {
        "matrix_rate": matrix,
        "flops": flops,
        "counted_seconds": taken,
        "rates": rates,
        "shares": {name: of / matrix for name, of in rates.items()},
        "rate": rate,
        "share": rate / matrix,
    }


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
