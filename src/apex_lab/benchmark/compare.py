"""A model against its naive twins: which trains more frames per second, measured in turns."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import multiprocessing
import signal
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import torch

from apex_lab.base import faults
from apex_lab.base.errors import UserError
from apex_lab.benchmark.child import death
from apex_lab.benchmark.measure import once, spread
from apex_lab.benchmark.work import Workload
from apex_lab.config.building import build_model
from apex_lab.config.composition import conf_dir
from apex_lab.config.schema import Config
from apex_lab.scene import SceneModel

MODEL = "model"
"""Name of the model itself among the compared ones."""


@dataclass(frozen=True)
class Comparison:
    """What to compare on.

    Attributes:
        config: of the run; its model has naive twins.
        device: "cpu" or "cuda".
        batch_size, frames: of the batch, the same for all.
        warmup, repeats: rounds before and during the measurement; in each, every model makes one step.
    """

    config: Config
    device: str
    batch_size: int
    frames: int
    warmup: int
    repeats: int


def twins_of(config: Config) -> dict[str, SceneModel] | None:
    """Naive twins of the model of a configuration, with its weights, by name; None where there are none.

    They lie in the repository's tests/reference/<model>.py, which has a function `twins(model, node)`; the installed
    package is without them.
    """
    model = build_model(config)
    package = type(model).__module__.removeprefix("apex_lab.models.").split(".")[0]
    name = f"tests.reference.{package}"
    root = str(conf_dir().parent)
    if root not in sys.path:
        sys.path.append(root)
    try:
        if importlib.util.find_spec(name) is None:
            return None
    except ModuleNotFoundError:
        return None
    return importlib.import_module(name).twins(model, config.model)


def workload(asked: Comparison, name: str) -> Workload:
    """One of the models of a comparison, with its batch and its optimiser."""
    device = torch.device(asked.device)
    model = None
    if name != MODEL:
        twins = twins_of(asked.config)
        assert twins is not None
        model = twins[name]
    return Workload(asked.config, device, asked.batch_size, asked.frames, model)


def timed_step(work: Workload) -> Callable[[], tuple[float, float]]:
    """A function that makes one training step and tells its seconds, and those of the processor."""
    step = work.step(training=True)

    def timed() -> tuple[float, float]:
        began = time.process_time()
        passed = once(step, work.device)
        return passed, time.process_time() - began

    return timed


def _serve(asked: Comparison, name: str, parent: Connection) -> None:
    """Makes a step whenever the parent asks for one, and ends with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent receives it too, and ends this process
    try:
        with faults.net(name):
            _answer(timed_step(workload(asked, name)), name, parent)
    except UserError as error:
        parent.send(UserError(str(error)))  # without its cause, which may not travel


def _answer(step: Callable[[], tuple[float, float]], name: str, parent: Connection) -> None:
    try:
        while True:
            parent.recv()
            parent.send(step())
    except EOFError:
        return
    except torch.OutOfMemoryError as error:
        less = "lower clips.batch_size, clips.frames or data.image_size, or set bench.compare=false."
        raise UserError(f"The GPU's memory does not hold the step of {name}: {less}") from error


@contextlib.contextmanager
def own_process(asked: Comparison, name: str) -> Iterator[Callable[[], tuple[float, float]]]:
    """`timed_step` of one of the models, made in a process that does nothing else.

    Raises:
        UserError: the process was ended by a signal, as happens when memory runs out, or the GPU's memory did.
        RuntimeError: the process ended otherwise; its traceback is on stderr.
    """
    context = multiprocessing.get_context("spawn")
    child, childs = context.Pipe()
    process = context.Process(target=_serve, args=(asked, name, childs), daemon=True)
    process.start()
    childs.close()

    def step() -> tuple[float, float]:
        try:
            child.send(None)
            told = child.recv()
        except (EOFError, ConnectionError) as error:
            raise death(process, f"The measurement of {name}") from error
        if isinstance(told, UserError):
            raise told
        return told

    try:
        yield step
    finally:
        process.kill()
        process.join()


def compare(asked: Comparison) -> dict[str, Any]:
    """Frames per second of the model and of its naive twins, and the ratios, round by round.

    Each model has a process of its own, as in a training, so that none works in memory that another has left behind;
    they make their steps in turns, so that whatever else the machine does meets them alike. On the CPU the ratios are
    told once more in processor time.

    Raises:
        UserError: memory ran out.
    """
    names = [MODEL, *(twins_of(asked.config) or {})]
    seconds: dict[str, list[float]] = {name: [] for name in names}
    processor: dict[str, list[float]] = {name: [] for name in names}
    with contextlib.ExitStack() as stack:
        steps = {name: stack.enter_context(own_process(asked, name)) for name in names}
        for i in range(asked.warmup + asked.repeats):
            for name, step in steps.items():
                passed, worked = step()
                if i >= asked.warmup:
                    seconds[name].append(passed)
                    processor[name].append(worked)
    ratios, in_processor_time = ({n: _ratios(times[MODEL], times[n]) for n in names} for times in (seconds, processor))
    frames = asked.batch_size * asked.frames
    return {
        "device": asked.device,
        "batch_size": asked.batch_size,
        "frames": asked.frames,
        "rounds": asked.repeats,
        "models": {
            name: {
                **spread(seconds[name], frames),
                "model_trains_times_as_many": statistics.median(ratios[name]),
                "times_min_max": [min(ratios[name]), max(ratios[name])],
                "times_in_processor_time": statistics.median(in_processor_time[name])
                if asked.device == "cpu"
                else None,
                "processor_seconds": statistics.median(processor[name]),
            }
            for name in names
        },
    }


def _ratios(ours: list[float], theirs: list[float]) -> list[float]:
    """Round by round, how many times as long theirs took."""
    return [b / a for a, b in zip(ours, theirs, strict=True)]
