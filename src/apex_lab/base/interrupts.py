"""Requests to stop (Ctrl-C, SIGTERM, a scheduler's warning) without loss of work.

A handler cannot rely on the exception that it raises: Python drops it where it happens to run a `__del__`, a callback
of a weak reference or of the garbage collector, or a callback of C code. So the handler notes the request before it
raises, and the code asks for the note (`check`) wherever stopping is safe: after a step, a batch, a video, a job.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from apex_lab.base.errors import UserError

ALWAYS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM") if hasattr(signal, name))
"""Signals that ask to stop."""

IF_FREE = tuple(getattr(signal, name) for name in ("SIGUSR1", "SIGUSR2", "SIGXCPU") if hasattr(signal, name))
"""Warnings that schedulers send before they kill; one that another library handles is left to it."""


class Interrupted(BaseException):
    """The process was asked to stop; a BaseException, so that no handler of errors catches it."""

    def __init__(self, signum: int) -> None:
        super().__init__(signum)
        self.signum = int(signum)

    def __str__(self) -> str:
        return signal.Signals(self.signum).name


@dataclass
class _State:
    """What this process knows of requests; signals belong to a process, so there is one.

    Attributes:
        signum: the first signal that came, or None.
        listening: how many blocks listen, one inside the other.
        deferring: how many of them only note the request.
        process: which process listens; a forked child inherits its handlers.
    """

    signum: int | None = None
    listening: int = 0
    deferring: int = 0
    process: int = 0


_state = _State()


def asked() -> int | None:
    """The signal that asked this process to stop, or None."""
    return _state.signum


def answered() -> None:
    """Forgets the request: it asked for no more than what has been done, as Ctrl-C ends a camera's endless video."""
    _state.signum = None


def check() -> None:
    """A safe point: stops if that was asked for and the work at hand is not deferring it.

    Raises:
        Interrupted: it was asked for.
    """
    if _state.signum is not None and not _state.deferring:
        raise Interrupted(_state.signum)


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """A request to stop raises `Interrupted` wherever the program is, and at the end of the block at the latest.

    Libraries that are stopped halfway may raise something else; that is the request's doing, and becomes `Interrupted`.
    """
    with _listening():
        try:
            yield
        except UserError:
            raise
        except Exception as error:
            if _state.signum is not None and not _state.deferring:
                raise Interrupted(_state.signum) from error
            raise
        check()


@contextlib.contextmanager
def deferring() -> Iterator[None]:
    """The first request is only noted (`asked`), so that work at hand can be stored; a second one stops at once.

    A request that is still there at the end of the block raises `Interrupted` then.
    """
    with _listening():
        _state.deferring += 1
        try:
            yield
        finally:
            _state.deferring -= 1
        check()


def _receive(signum: int, frame: object) -> None:
    if os.getpid() != _state.process:
        _in_child(signum)
        return
    first = _state.signum is None
    _state.signum = _state.signum or signum
    if first and _state.deferring:
        with contextlib.suppress(OSError):  # nobody may be reading; and print is not safe in here
            os.write(2, b"Stopping when this step is stored; once more stops at once.\n")
        return
    raise Interrupted(_state.signum)


def _in_child(signum: int) -> None:
    """A forked process, such as a loader of data: its parent decides when to stop, and may end it."""
    if signum == signal.SIGTERM:
        signal.signal(signum, signal.SIG_DFL)
        os.kill(os.getpid(), signum)


@contextlib.contextmanager
def _listening() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield  # Python delivers signals to the main thread alone
        return
    own = (signal.SIG_DFL, _receive)
    before = {number: signal.getsignal(number) for number in (*ALWAYS, *IF_FREE)}
    taken = [number for number, handler in before.items() if number in ALWAYS or handler in own]
    if _state.process != os.getpid():  # never listened, or a forked child that starts work of its own
        _state.signum, _state.listening, _state.deferring, _state.process = None, 0, 0, os.getpid()
    for number in taken:
        signal.signal(number, _receive)
    _state.listening += 1
    reported = sys.unraisablehook

    def report(what: Any) -> None:
        if not isinstance(what.exc_value, Interrupted):  # the note of it acts; a traceback would only alarm
            reported(what)

    sys.unraisablehook = report
    try:
        yield
    finally:
        sys.unraisablehook = reported
        _state.listening -= 1
        if _state.listening == 0:
            _state.signum = None
        for number in taken:
            signal.signal(number, signal.SIG_DFL if before[number] is None else before[number])  # None: not Python's
