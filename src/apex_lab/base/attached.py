"""The side of a job that another process has started for a sweep: it stops with that process, and tells it its end.

`apex_lab.config.elsewhere` is the other side. Between the two are a pipe and a file. The pipe is the standard input of
this process: a request to stop comes over it as the number of a signal, and its end means that the other side died. The
file takes how the job ended.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import threading
from pathlib import Path

from apex_lab.base import interrupts

END = "APEX_LAB_END"
"""Environment variable: the file for how the job ended."""

_file: Path | None = None


def listen() -> None:
    """Starts to take requests to stop from the process that has started this one, if one did that."""
    global _file
    name = os.environ.pop(END, None)  # processes that this one starts are not attached
    if name is not None:
        _file = Path(name)
        threading.Thread(target=_listen, daemon=True, name="requests to stop").start()


def _listen() -> None:
    number = os.read(0, 16)  # empty when the other side has died
    if interrupts.asked() is None:  # Slurm sends its signals to all processes of a job, and a second one stops at once
        os.kill(os.getpid(), int(number) if number else signal.SIGTERM)


def tell(state: str, reason: str | None = None) -> None:
    """Leaves how the job ended for the process that waits for it, if there is one.

    Args:
        state: finished, paused, failed, busy, interrupted.
        reason: a sentence; for interrupted, the name of the signal.
    """
    if _file is not None:
        with contextlib.suppress(OSError):  # the other side has died
            _file.write_text(json.dumps({"state": state, "reason": reason}), encoding="utf-8")
