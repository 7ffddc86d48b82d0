"""How a command of this package ends: with an exit code and, where it fails, one sentence."""

from __future__ import annotations

import argparse
import errno
import os
import shlex
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from recordings.streams import open_streams, say
from sims.errors import SimError

LONGEST = 400
"""Characters of a message that a sentence cites at most; the file has all of it."""


def ending(work: Callable[[], int], kept: str) -> int:
    """Does the work of a command, and tells what stopped it.

    Args:
        work: returns the exit code.
        kept: what is not lost when it is stopped, and how it goes on.

    Returns:
        The exit code: that of the work; 1 where something was raised, 128 + n after signal n.
    """
    open_streams()
    try:
        with _terminable():
            return work()
    except SimError as error:
        say(str(error), error=True)
        return 1
    except KeyboardInterrupt as stop:
        terminated = isinstance(stop, _Terminated)
        say(f"{'terminated' if terminated else 'interrupted'}; {kept}", error=True)
        return 128 + (signal.SIGTERM if terminated else signal.SIGINT)
    except Exception as error:  # noqa: BLE001 - what nobody foresaw
        say(f"out of memory ({error}); {kept}" if _no_memory(error) else told(error), error=True)
        return 1


def _no_memory(error: Exception) -> bool:
    """Whether memory ran out; threads that cannot be started lack it too."""
    return isinstance(error, MemoryError) or "can't start new thread" in str(error)


def positive(text: str) -> int:
    """A number from 1 on, for an option of `argparse`."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not at least 1")
    return value


def path_argument(text: str) -> Path:
    """A path for an option of `argparse`; an empty one, as an unset variable gives it, would be the current folder."""
    if not text.strip():
        raise argparse.ArgumentTypeError("it is empty, as an unset variable is: give a path")
    try:
        os.lstat(text)
    except (OSError, ValueError) as error:
        if isinstance(error, ValueError) or error.errno in (errno.ENAMETOOLONG, errno.EINVAL):
            raise argparse.ArgumentTypeError(f"no path can be so ({error})") from error
    return Path(text)


def told(error: BaseException) -> str:
    """One sentence for what was not foreseen; its traceback is stored in a file, which the sentence names."""
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        text = f"{os.fsdecode(error.filename)}: {error.strerror}"
    else:
        text = f"{type(error).__name__}: {' '.join(str(error).split())}"
    if len(text) > LONGEST:
        text = f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"
    return f"{text.rstrip(': .')} ({_stored(error)})."


def _stored(error: BaseException) -> str:
    try:
        handle, name = tempfile.mkstemp(prefix=time.strftime("sims_%Y%m%d_%H%M%S_"), suffix=".log")
        with open(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write("\n".join([shlex.join(sys.argv), "", *traceback.format_exception(error)]))
    except OSError as full:
        return f"its traceback could not be stored: {full.strerror}"
    return f"traceback: {Path(name)}"


class _Terminated(KeyboardInterrupt):
    """SIGTERM came."""


@contextmanager
def _terminable() -> Iterator[None]:
    """Ends the work in order on Ctrl-C, and on SIGTERM too, as a scheduler sends it."""

    def stop(*_: object) -> None:
        raise _Terminated

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {signum: signal.getsignal(signum) for signum in (signal.SIGTERM, signal.SIGINT)}
    signal.signal(signal.SIGTERM, stop)
    if before[signal.SIGINT] is signal.SIG_DFL:  # as while a command starts (`sims`)
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)
