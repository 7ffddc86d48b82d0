"""Other processes of this machine."""

from __future__ import annotations

import psutil


def alive(pid: int) -> bool:
    """Whether a process runs. One that has died and that its parent has not looked at yet, a zombie, does not."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
    except psutil.Error:  # there, and another user's
        return True
