"""What a configuration may ask of the machine: found out before anything is built or begun, in bounded time.

A model is built to be checked. So building is bounded: by the memory that is free, by the number of its parts, and by
processor time, after which a check that does not end is ended.
"""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any

from torch import nn
from torch.nn.modules.module import (
    register_module_module_registration_hook,
    register_module_parameter_registration_hook,
)

from apex_lab.base.errors import UserError
from apex_lab.base.machine import GIGABYTE, bounded_memory, memory
from apex_lab.base.validation import shown

PARTS = 20_000
"""Modules of a model at most; those of this package have some hundreds."""

SECONDS = 15.0
"""Processor time of the main thread that building takes at most; the models of this package take less than one."""

LARGEST = 2**63
"""Whole numbers lie below it in size: NumPy and PyTorch count with 64 bits."""

COPIES = 4
"""Of each weight in training: itself, its gradient, and two running means of an optimiser such as Adam."""


def refuse_long_numbers(value: Any, key: str = "") -> None:
    """Looks for whole numbers that no array could count.

    Raises:
        UserError: one is there.
    """
    if isinstance(value, Mapping):
        for name, item in value.items():
            refuse_long_numbers(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            refuse_long_numbers(item, f"{key}[{i}]")
    elif isinstance(value, int) and not -LARGEST <= value < LARGEST:
        raise UserError(f"{key} = a whole number of {value.bit_length()} bits is wrong: give one of 64 bits at most.")


@contextlib.contextmanager
def bounded(copies: int = COPIES) -> Iterator[None]:
    """Inside, building fails in place of filling the memory or never ending.

    Args:
        copies: of each weight that will be needed.

    Raises:
        UserError: too many parts or weights, or it takes too long.
    """
    count = size = 0
    most = memory()

    def register(module: nn.Module, name: str, part: nn.Module | None) -> None:
        nonlocal count
        count += 1
        if count > PARTS:
            raise UserError(f"it has more than {PARTS:,} parts, which no model here needs: choose smaller depths")

    def weigh(module: nn.Module, name: str, weight: nn.Parameter | None) -> None:
        """Comes before the weight is initialised, so none of its memory is in use yet."""
        nonlocal size
        size += 0 if weight is None else weight.numel() * weight.element_size()
        if copies * size > most:
            raise UserError(
                f"its weights take more than the {most / GIGABYTE:.0f} GB of this machine"
                f"{' in training' if copies > 1 else ''}: choose smaller sizes"
            )

    hooks = [register_module_module_registration_hook(register), register_module_parameter_registration_hook(weigh)]
    try:
        with bounded_memory(), _bounded_time():
            yield
    finally:
        for hook in hooks:
            hook.remove()


@contextlib.contextmanager
def _bounded_time() -> Iterator[None]:
    """Inside, the main thread is interrupted when the process has computed for too long."""
    usable = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()
    if not usable or signal.getitimer(signal.ITIMER_VIRTUAL)[0] > 0 or signal.getsignal(signal.SIGVTALRM) is None:
        yield  # somebody else, such as a profiler or a block around this one, has the clock
        return

    began = time.thread_time()

    def look(signum: int, frame: object) -> None:
        """The timer counts all threads; only this one's time counts here, however many cores initialise weights."""
        if time.thread_time() - began > SECONDS:
            raise UserError(f"building it takes more than {SECONDS:g} seconds: choose smaller sizes")

    before = signal.signal(signal.SIGVTALRM, look)
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS / 10, SECONDS / 10)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def refuse_large_batches(config: Mapping[str, Any], clip_frames: int | None) -> None:
    """Compares batches of training and evaluation, and the lists of videos, with the memory of the machine.

    Args:
        config: a checked configuration as plain containers.
        clip_frames: of the longest clip; None: whole videos.

    Raises:
        UserError: they cannot fit.
    """
    data = config["data"]
    frames, side = (_count(data.get(name)) for name in ("frames", "image_size"))
    if frames is not None and side is not None:
        pixels, sizes = 3 * side * side, ("frames", "image_size")
        clips = config["clips"]["batch_size"] * (clip_frames or frames)
        _refuse(4 * clips * pixels, f"a batch of {clips:,} frames", "clips.batch_size", config, sizes)
        asked = config["evaluation"]
        whole = asked["batch_size"] * frames  # videos are whole until they are cut into chunks; pixels are bytes then
        size = whole * pixels + 4 * asked["batch_size"] * min(frames, asked["chunk"] or frames) * pixels
        _refuse(size, f"{whole:,} frames of whole videos", "evaluation.batch_size", config, sizes)
    for split in ("train", "val", "test"):
        if (videos := _count(data.get(split))) is not None:
            _refuse(64 * videos, f"a list of {videos:,} videos", "", config, (split,))


def _count(value: Any) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) and value > 0 else None


def _refuse(size: int, what: str, batch: str, config: Mapping[str, Any], names: tuple[str, ...]) -> None:
    if size <= memory():
        return
    keys = [f"data.{name} = {shown(config['data'][name])}" for name in names]
    if batch:
        group, _, key = batch.partition(".")
        keys.insert(0, f"{batch} = {config[group][key]}")
    raise UserError(
        f"{', '.join(keys)}: {what} would take {size / GIGABYTE:,.0f} GB, and this machine has "
        f"{memory() / GIGABYTE:.0f} GB: choose smaller numbers."
    )
