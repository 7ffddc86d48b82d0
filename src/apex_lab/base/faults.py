"""What nobody foresaw: any exception becomes one sentence, which names the file with its traceback."""

from __future__ import annotations

import os
import shlex
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import apex_lab
from apex_lab.base.errors import UserError
from apex_lab.base.files import is_full, unwritable
from apex_lab.base.validation import one_line, short

LONGEST = 400
"""Characters of a message that a sentence cites at most; the file has all of it."""


@contextmanager
def net(where: str = "") -> Iterator[None]:
    """Inside, an exception that is no `UserError` becomes one.

    Args:
        where: the key or file at hand, for the sentence.

    Raises:
        UserError: one sentence that names the file with the traceback.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        raise UserError(told(error, where)) from error


def told(error: BaseException, where: str = "") -> str:
    """The sentence for an exception that was not foreseen; its traceback is stored.

    Args:
        error: the exception.
        where: the key or file at hand.
    """
    if isinstance(error, OSError) and is_full(error):
        # the system names no file when a write to an open one fails; most lie below the folder at hand
        named = error.filename if error.filename is not None else os.path.join(_folder(), "...")
        return str(unwritable(Path(os.fsdecode(named)), error))
    return f"{where}{': ' if where else ''}{cited(error)} ({stored(''.join(traceback.format_exception(error)))})."


def cited(error: BaseException) -> str:
    """Kind and message of an exception on one line of bounded length, without a full stop."""
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        text = f"{short(os.fsdecode(error.filename), LONGEST // 2)}: {error.strerror}"
    else:
        text = one_line(error)
        if text != type(error).__name__:  # else it has no message
            text = f"{type(error).__name__}: {text}"
    return short(text, LONGEST).rstrip(".")


def stored(trace: str) -> str:
    """Writes a traceback into a file of its own among the temporary ones; what a sentence says of it."""
    lines = [
        f"{time.strftime('%Y-%m-%d %H:%M:%S')}  apex_lab {apex_lab.__version__}, Python {sys.version.split()[0]}",
        f"in {_folder()}: {shlex.join(sys.argv)}",
        "",
        trace,
    ]
    try:
        handle, name = tempfile.mkstemp(prefix=time.strftime("apex_lab_%Y%m%d_%H%M%S_"), suffix=".log")
        with open(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write("\n".join(lines))
    except OSError as full:
        return f"its traceback could not be stored: {full.strerror}"
    return f"traceback: {Path(name)}"


def _folder() -> str:
    try:
        return os.getcwd()
    except OSError:  # it was removed
        return "a folder that is gone"
