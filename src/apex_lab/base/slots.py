"""A machine's cores and GPUs, divided into slots for jobs that run side by side. Imports no PyTorch.

A job claims a free slot by locking its file, so a slot becomes free when its owner dies, however that happens. The file
is named by what the slot holds, so two sweeps that divide a machine alike share its slots and do not overload it.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from filelock import FileLock, Timeout

from apex_lab.base.files import make_folder

T = TypeVar("T")

POLL = 0.5
"""Seconds between two looks for a free slot."""


@dataclass(frozen=True)
class Slot:
    """What one job may use.

    Attributes:
        cores: numbers of CPU cores.
        gpus: words of CUDA_VISIBLE_DEVICES; empty where the machine has none.
    """

    cores: tuple[int, ...]
    gpus: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """For people, and for the name of its file."""
        cores = "-".join(str(core) for core in sorted({self.cores[0], self.cores[-1]}))
        gpus = f"_gpus_{'-'.join(self.gpus)}" if self.gpus else ""
        return f"cores_{cores}{gpus}".replace("/", "-")

    @property
    def environment(self) -> dict[str, str]:
        """Variables of a process that starts in this slot."""
        variables = {}
        if self.gpus:
            variables["CUDA_VISIBLE_DEVICES"] = ",".join(self.gpus)
        if not hasattr(os, "sched_setaffinity"):  # where a process can be pinned, PyTorch counts the cores it may use
            variables["OMP_NUM_THREADS"] = str(len(self.cores))
        return variables

    def pin(self, pid: int) -> None:
        """Keeps a process, and what it starts from now on, on the slot's cores, where the system can do that."""
        if hasattr(os, "sched_setaffinity"):
            with contextlib.suppress(OSError):  # it has ended already, or a core is gone
                os.sched_setaffinity(pid, self.cores)


def divided(number: int, cores: Sequence[int], gpus: Sequence[str] = ()) -> list[Slot]:
    """Slots of equal size.

    Args:
        number: of slots, at least 1. With more slots than cores or GPUs, neighbours share one.
        cores: what there is, at least one.
        gpus: what there is.
    """
    return [Slot(_share(cores, slot, number), _share(gpus, slot, number)) for slot in range(number)]


def _share(things: Sequence[T], slot: int, slots: int) -> tuple[T, ...]:
    begin = slot * len(things) // slots
    return tuple(things[begin : max((slot + 1) * len(things) // slots, begin + 1)])


def machine(number: int) -> list[Slot]:
    """The cores and GPUs that this process may use, in slots."""
    if hasattr(os, "sched_getaffinity"):
        cores = sorted(os.sched_getaffinity(0))
    else:
        cores = list(range(os.cpu_count() or 1))
    return divided(number, cores, visible_gpus())


def visible_gpus() -> list[str]:
    """Words of CUDA_VISIBLE_DEVICES for each GPU that this process may use, found without a CUDA context."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    if given is not None:
        return [word.strip() for word in given.split(",") if word.strip() not in ("", "-1")]
    if shutil.which("nvidia-smi") is None:
        return []
    listed = subprocess.run(
        ["nvidia-smi", "--query-gpu=index", "--format=csv,noheader"], capture_output=True, text=True, check=False
    )
    return listed.stdout.split() if listed.returncode == 0 else []


def folder() -> Path:
    """Where this user's slots of this machine lie; on a local disk, where locks are sure."""
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "")
    return Path(tempfile.gettempdir()) / f"apex_lab_slots_{user}"


@contextlib.contextmanager
def claimed(slots: Sequence[Slot], where: Path, idle: Callable[[], None] = lambda: None) -> Iterator[Slot]:
    """Inside, one of the slots belongs to this process.

    Args:
        slots: equally good ones.
        where: folder of their files.
        idle: called between two looks while all are taken; may raise to give up.

    Raises:
        UserError: the folder cannot be written.
    """
    make_folder(where)
    while True:
        for number, slot in enumerate(slots):
            same = sum(other == slot for other in slots[:number])  # neighbours that share what they hold
            lock = FileLock(str(where / f"{slot.name}_{same}.lock"))
            try:
                lock.acquire(blocking=False)
            except Timeout:
                continue
            try:
                yield slot
            finally:
                lock.release()
            return
        idle()
        time.sleep(POLL)
