"""How the simulator's commands end when they are asked to stop: in order, with one sentence, and 128 + n."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Terminated(KeyboardInterrupt):
    """SIGTERM came."""


def stoppable(work: Callable[[], int], kept: str) -> int:
    """Does a command's work; a request to stop ends it with a sentence.

    Args:
        work: returns the exit code.
        kept: what of it stays, such as "finished trajectories".

    Returns:
        The exit code; 130 after Ctrl-C, 143 after SIGTERM, 1 when memory has run out.
    """
    try:
        with _terminable():
            return work()
    except KeyboardInterrupt as stop:
        by_signal = isinstance(stop, Terminated)
        what = "terminated" if by_signal else "interrupted"
        print(f"{what}; {kept} are kept, run the same command to resume", file=sys.stderr)
        return 143 if by_signal else 130
    except (MemoryError, RuntimeError) as error:
        if not _no_memory(error):
            raise
        print(f"out of memory ({error}); {kept} are kept, run the same command to resume", file=sys.stderr)
        return 1


def _no_memory(error: Exception) -> bool:
    """Whether memory ran out; threads that cannot be started lack it too."""
    return isinstance(error, MemoryError) or "can't start new thread" in str(error)


@contextmanager
def _terminable() -> Iterator[None]:
    """Ends the work in order on SIGTERM too, as a scheduler sends it."""

    def stop(*_: object) -> None:
        raise Terminated

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
