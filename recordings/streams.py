"""Lines for the person who waits. What cannot be printed never stops any work."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import IO


def open_streams() -> None:
    """Makes the standard streams of this process take whatever is printed.

    Characters that a terminal lacks are replaced. A stream that was closed leads nowhere; its number would otherwise be
    that of the next file that is opened, into which others then print.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            with contextlib.suppress(OSError):
                _close_gap(number)
            setattr(sys, name, open(os.devnull, "r" if number == 0 else "w"))  # noqa: SIM115 - for good
        elif number and getattr(stream, "errors", None) == "strict" and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")


def say(line: str, *, error: bool = False) -> None:
    """Prints a line on standard output or error, as far as that is possible."""
    stream = sys.stderr if error else sys.stdout
    if stream is None:
        return
    try:
        print(line, file=stream, flush=True)
    except (OSError, ValueError):  # nobody reads any more (`| head`), the disk is full, or it is closed
        silence(stream)


def silence(stream: IO[str]) -> None:
    """Leads a stream nowhere, so that nothing that is left in it is written at the end of the process either."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def _close_gap(number: int) -> None:
    try:
        os.fstat(number)
    except OSError:
        nowhere = os.open(os.devnull, os.O_RDWR)
        if nowhere != number:
            os.dup2(nowhere, number)
            os.close(nowhere)
