"""The processes of loaders: how they are started, and how they end."""

from __future__ import annotations

import os
import signal
from typing import Any

import torch
from torch.utils.data import DataLoader

from recordings import cores


def options(workers: int) -> dict[str, Any]:
    """Of a `DataLoader` with so many processes, at most one on each core; zero: it loads in this one."""
    workers = min(workers, cores())  # a job of a sweep may have one core
    return {
        "num_workers": workers,
        "persistent_workers": workers > 0,
        "worker_init_fn": _outlive_one_request if workers else None,
        "pin_memory": torch.cuda.is_available(),
        # a generator of its own: starting a loader must not change the random numbers of the training
        "generator": torch.Generator().manual_seed(0),
    }


def stop(loader: DataLoader[Any]) -> None:
    """Ends a loader's processes, also after an error.

    The error's traceback holds the loader until Python exits, and that would send SIGTERM and wait `GRACE` seconds.
    """
    if loader._iterator is not None:  # it has processes
        loader._iterator._shutdown_workers()  # type: ignore[attr-defined]
        loader._iterator = None


GRACE = 60
"""Seconds that a loading process lives on after its first SIGTERM."""


def _outlive_one_request(worker: int) -> None:
    """In a loading process: the parent decides when to stop, also where a signal goes to all processes of a job.

    A loader that died of it at once would take the step at hand with it. Its second SIGTERM (PyTorch sends one at the
    end to a loader that hangs) or the end of the grace ends it.
    """

    def first(signum: int, frame: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        if os.name == "posix":
            signal.alarm(GRACE)

    for name in ("SIGINT", "SIGUSR1", "SIGUSR2", "SIGXCPU"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    signal.signal(signal.SIGTERM, first)
