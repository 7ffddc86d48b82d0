"""Measures one row: speed, seconds by part, peak memory, graph breaks, kernels; all in the process that calls it."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch._dynamo.exc import TorchDynamoException
from torch._dynamo.utils import counters

from apex_lab.base.validation import one_line
from apex_lab.benchmark.arithmetic import shares
from apex_lab.benchmark.profile import seconds_by_part
from apex_lab.benchmark.work import Workload
from apex_lab.config.schema import Config
from apex_lab.training.update import CAPTURED, WARMUP, Mode

GIB = 2**30


@dataclass(frozen=True)
class Case:
    """One row to measure.

    Attributes:
        config: of the run; its precision is that of the row.
        device: "cpu" or "cuda".
        mode: as of `WeightUpdate`; a CUDA graph holds a training step.
        training: a training step, or an inference.
        batch_size, frames: of the batch.
        warmup, repeats: steps before and during the measurement; those before a capture, and with it, come on top.
        by_part: seconds by part too, which takes as many steps again.
    """

    config: Config
    device: str
    mode: Mode
    training: bool
    batch_size: int
    frames: int
    warmup: int
    repeats: int
    by_part: bool = True


def measure(case: Case) -> dict[str, Any]:
    """The values of one row; see the keys. `unavailable` holds a sentence where the case cannot be run here."""
    device = torch.device(case.device)
    before = peak_memory(device)
    work = Workload(case.config, device, case.batch_size, case.frames, mode=case.mode)
    row: dict[str, Any] = {
        "device": case.device,
        "mode": case.mode,
        "precision": str(case.config.trainer.precision),
        "matmul_precision": case.config.trainer.matmul_precision if device.type == "cuda" else None,
        "what": "training step" if case.training else "inference",
        "batch_size": case.batch_size,
        "frames": case.frames,
        "image_size": case.config.data["image_size"],
        "repeats": case.repeats,
        "unavailable": None,
    }
    step, captured = work.step(case.training), case.mode in CAPTURED
    counters.clear()
    began = time.perf_counter()
    try:
        with torch.random.fork_rng(devices=[]):
            seconds = timed(step, device, case.warmup + (WARMUP + 1 if captured else 0), case.repeats)
    except TorchDynamoException as error:
        # PyTorch's own compiler could not do it here (no C++ compiler, no Triton): that is this row's result
        return {**row, "unavailable": f"cannot be compiled here: {_reason(error)}"}
    except torch.OutOfMemoryError:
        return {**row, "unavailable": "the GPU's memory does not hold it"}
    row |= spread(seconds, work.frames)
    row["setup_seconds"] = time.perf_counter() - began - sum(seconds)
    row["peak_memory_gib"] = peak_memory(device)
    row["memory_before_gib"] = before
    if case.mode.startswith("compiled"):
        row["graph_breaks"] = sum(counters["graph_break"].values())
        row["graphs"] = counters["stats"]["unique_graphs"]
    elif case.by_part and not captured:
        row["parts"] = parts(work, case)
        row["arithmetic"] = shares(step, device, row["parts"], work.rewound)
    if device.type == "cuda":
        row |= kernels(step)
    return row


def timed(step: Callable[[], object], device: torch.device, warmup: int, repeats: int) -> list[float]:
    """Seconds of each of `repeats` steps after `warmup` others; the device is idle before and after each."""
    return [once(step, device) for _ in range(warmup + repeats)][warmup:]


def once(step: Callable[[], object], device: torch.device) -> float:
    """Seconds of one step, from an idle device to an idle device."""
    _wait(device)
    began = time.perf_counter()
    step()
    _wait(device)
    return time.perf_counter() - began


def spread(seconds: list[float], frames: int) -> dict[str, Any]:
    """Median, smallest and largest of a step's seconds, and of its frames per second."""
    middle, low, high = statistics.median(seconds), min(seconds), max(seconds)
    return {
        "seconds": middle,
        "seconds_min_max": [low, high],
        "frames_per_second": frames / middle,
        "frames_per_second_min_max": [frames / high, frames / low],
    }


def parts(work: Workload, case: Case) -> dict[str, float]:
    """Median seconds of each part over as many further steps, under the profiler; empty parts are left out."""
    runs = [seconds_by_part(work.step(case.training), work.device) for _ in range(case.repeats)]
    names = dict.fromkeys(name for run in runs for name in run)
    return {name: statistics.median(run.get(name, 0.0) for run in runs) for name in names}


def kernels(step: Callable[[], object]) -> dict[str, int]:
    """How many kernels (and copies) one step runs on the GPU, and how many launches from the host that takes."""
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiled:
        step()
        torch.cuda.synchronize()
    events, on_gpu = list(profiled.events()), torch.autograd.DeviceType.CUDA
    return {
        "kernels": sum(event.device_type == on_gpu and not event.is_user_annotation for event in events),
        "launches": sum("LaunchKernel" in event.name or "GraphLaunch" in event.name for event in events),
    }


def peak_memory(device: torch.device) -> float | None:
    """The most memory in GiB that was held so far: by tensors on a GPU, else by this process (its resident set).

    None where the system does not report it.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / GIB
    if sys.platform == "linux":
        # not getrusage: a child's value begins with the parent's at the time of the fork
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) / 2**20 for line in lines if line.startswith("VmHWM:"))
    if sys.platform == "darwin":
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / GIB
    return None


def _reason(error: TorchDynamoException) -> str:
    """The first line of what stood in the way, which the compiler wraps in exceptions of its own."""
    inner = getattr(error, "inner_exception", None) or error.__cause__ or error
    return one_line(str(inner).strip().partition("\n")[0] or type(inner).__name__)


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
