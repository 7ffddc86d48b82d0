"""Interrupts (Ctrl-C, SIGTERM) without loss of work."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(BaseException):
    """The process was asked to stop; a BaseException, so that no handler of errors catches it."""

    def __init__(self, signum: int) -> None:
        super().__init__(signal.Signals(signum).name)
        self.signum = signum


class Deferred:
    """A request to stop that waits until the work at hand is stored.

    Attributes:
        signum: the signal that came, or None.
    """

    def __init__(self) -> None:
        self.signum: int | None = None

    def act(self) -> None:
        """Stops now, if that was asked for.

        Raises:
            Interrupted: it was.
        """
        if self.signum is not None:
            raise Interrupted(self.signum)

    def receive(self, signum: int, frame: object) -> None:
        """Takes a signal; a second one stops at once."""
        self.act()
        self.signum = signum
        os.write(2, b"Stopping when this step is stored; once more stops at once.\n")  # print is not safe in here


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Ctrl-C and SIGTERM raise `Interrupted` wherever the program is."""

    def stop(signum: int, frame: object) -> None:
        raise Interrupted(signum)

    with _handled(stop):
        yield


@contextlib.contextmanager
def deferring() -> Iterator[Deferred]:
    """The first Ctrl-C or SIGTERM is only noted; the code inside acts on it with `Deferred.act`."""
    deferred = Deferred()
    with _handled(deferred.receive):
        yield deferred


@contextlib.contextmanager
def _handled(handler: object) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield  # Python delivers signals to the main thread alone
        return
    before = {number: signal.signal(number, handler) for number in _SIGNALS}  # type: ignore[arg-type]
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
