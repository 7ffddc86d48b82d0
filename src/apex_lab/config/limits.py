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

COPIES = 4
"""Of each weight in training: itself, its gradient, and two running means of an optimiser such as Adam."""


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
        batch = config["clips"]["batch_size"]
        clips = batch * (clip_frames or frames)
        keys = {"clips.batch_size": batch, "data.frames": frames, "data.image_size": side}
        _refuse(4 * clips * 3 * side * side, f"a batch of {clips:,} frames", keys)
    asked = config["evaluation"]
    refuse_large_videos(data, asked["batch_size"], asked["chunk"], "evaluation.batch_size")


def refuse_large_videos(data: Mapping[str, Any], batch_size: int, chunk: int | None, key: str) -> None:
    """Compares whole videos, and the lists of videos, with the memory of the machine.

    Args:
        data: the node of the data set.
        batch_size: videos at once, where the data set has so many.
        chunk: frames that a model sees at once; None: all.
        key: of the batch size, for the message.

    Raises:
        UserError: they cannot fit.
    """
    counts = {f"data.{split}": _count(data.get(split)) for split in ("train", "val", "test")}
    for split, videos in counts.items():
        if videos is not None:
            _refuse(64 * videos, f"a list of {videos:,} videos", {split: videos})
    frames, side = (_count(data.get(name)) for name in ("frames", "image_size"))
    if frames is not None and side is not None:
        pixels, batch = 3 * side * side, batch_size
        if all(videos is not None for videos in counts.values()):
            batch = min(batch, max(videos or 0 for videos in counts.values()))
        whole = batch * frames  # videos are whole until they are cut into chunks; pixels are bytes then
        size = whole * pixels + 4 * batch * min(frames, chunk or frames) * pixels
        keys = {key: batch_size, "data.frames": frames, "data.image_size": side}
        _refuse(size, f"{whole:,} frames of whole videos", keys)


def _count(value: Any) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) and value > 0 else None


def _refuse(size: int, what: str, keys: Mapping[str, Any]) -> None:
    if size <= memory():
        return
    raise UserError(
        f"{', '.join(f'{key} = {shown(value)}' for key, value in keys.items())}: {what} would take "
        f"{size / GIGABYTE:,.0f} GB, and this machine has {memory() / GIGABYTE:.0f} GB: choose smaller numbers."
    )
