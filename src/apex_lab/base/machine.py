"""What memory this machine, or the container or job that this process runs in, has."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path

import psutil

GIGABYTE = 1e9

_CONTROLLERS = (("memory.max", "memory.current", ""), ("memory.limit_in_bytes", "memory.usage_in_bytes", "memory"))
"""Names of limit and use, and of the folder, in the two versions of Linux's control groups."""


def memory() -> int:
    """Bytes of memory that a process can have here: the machine's, or the least of its control groups."""
    return min([psutil.virtual_memory().total, *(limit for limit, _ in _groups())])


def free_memory() -> int:
    """Bytes of memory that are free now, swap included."""
    free = psutil.virtual_memory().available + psutil.swap_memory().free
    return max(0, min([free, *(limit - used for limit, used in _groups())]))


def _groups(root: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> Iterator[tuple[int, int]]:
    """(limit, use) of every control group that this process is in and that has a limit."""
    try:
        lines = own.read_text().splitlines()
    except OSError:  # not Linux
        return
    for line in lines:
        _, controllers, place = line.split(":", 2)
        for limit, use, folder in _CONTROLLERS:
            if folder in controllers.split(","):
                inner = root / folder / place.lstrip("/")
                for group in (inner, *inner.parents):
                    if group.is_relative_to(root / folder):
                        with contextlib.suppress(OSError, ValueError):  # no limit ("max"), or out of sight
                            yield int((group / limit).read_text()), _in_use(group, use)


def _in_use(group: Path, use: str) -> int:
    """Bytes without what the kernel keeps of files and gives back when it is asked to."""
    used = int((group / use).read_text())
    for line in (group / "memory.stat").read_text().splitlines():
        name, _, value = line.partition(" ")
        if name in ("inactive_file", "total_inactive_file"):
            return max(0, used - int(value))
    return used


@contextlib.contextmanager
def bounded_memory() -> Iterator[None]:
    """Inside, taking more memory than is free raises an exception, where the system would end the process.

    Where the system has no such bounds (Linux has them), and in other threads than the main one, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # the bound is the process's: two threads would undo each other's
        return
    try:
        import resource

        before = resource.getrlimit(resource.RLIMIT_DATA)
        most = _data() + free_memory()
        if before[0] == resource.RLIM_INFINITY or most < before[0]:
            resource.setrlimit(resource.RLIMIT_DATA, (most, before[1]))
    except (ImportError, OSError, ValueError):
        yield
        return
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _data() -> int:
    """Bytes that the limit counts as taken by this process already.

    Raises:
        OSError, ValueError: the system does not tell.
    """
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmData:"):
            return int(line.split()[1]) * 1024
    raise ValueError("no VmData")
