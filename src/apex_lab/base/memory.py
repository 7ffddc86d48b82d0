"""Memory that this process has freed stays with it, so that the next training step need not ask the system again."""

from __future__ import annotations

import ctypes
import sys

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Keys of glibc's mallopt(3)."""

KEPT = 2**30
"""Free bytes at the end of the heap above which they go back to the system."""

LARGEST = 2**25
"""Bytes of the largest block that comes from the heap; the most that every version of glibc takes."""


def keep_freed_memory() -> bool:
    """Lets glibc's allocator reuse freed blocks of some megabytes; False where the allocator is another one.

    It otherwise gives the memory of a training step back, and the next step gets pages that the system must first fill
    with zeros: on a CPU 5 % of a step of APEX at `scale=cpu`.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is None:
        return False
    return bool(mallopt(M_MMAP_THRESHOLD, LARGEST)) and bool(mallopt(M_TRIM_THRESHOLD, KEPT))
