"""Messages to the person at the terminal and to a run's log.txt. What cannot be printed never stops any work."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from apex_lab.base.files import unwritable

_LOG = logging.getLogger("apex_lab")


class _ToStream(logging.Handler):
    """Messages to stdout, warnings and errors to stderr, whichever streams these are at that moment."""

    def emit(self, record: logging.LogRecord) -> None:
        put(self.format(record) + "\n", error=record.levelno >= logging.WARNING)


class _ToFile(logging.FileHandler):
    """Messages to a file; one that can be written no longer costs one warning."""

    def handleError(self, record: logging.LogRecord) -> None:
        _LOG.removeHandler(self)  # first, since the warning would come here too
        _LOG.warning(f"{self.baseFilename} cannot be written ({sys.exc_info()[1]}): further messages are not in it.")

    def close(self) -> None:
        with contextlib.suppress(OSError):  # what is left over of a disk that is full
            super().close()


def setup() -> None:
    """Sends messages to the terminal and quietens libraries that report on themselves."""
    _open_streams()
    if not any(isinstance(handler, _ToStream) for handler in _LOG.handlers):
        _LOG.addHandler(_ToStream(logging.INFO))
    _LOG.setLevel(logging.DEBUG)
    _LOG.propagate = False
    for name in ("lightning.pytorch", "lightning.fabric", "lightning"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings("ignore", message=".*No device id is provided.*")
    warnings.filterwarnings("ignore", message=".*have no `val_dataloader`.*")
    warnings.filterwarnings("ignore", message="Grad strides do not match bucket view strides")  # channels last
    warnings.filterwarnings("ignore", message=".*treespec, LeafSpec.*")
    warnings.filterwarnings("ignore", message=".*GPU available but not used.*")


def put(text: str, error: bool = False) -> None:
    """Prints text as it is, on standard error or output, as far as that is possible."""
    stream = sys.stderr if error else sys.stdout
    if stream is None:
        return
    try:
        stream.write(_printable(text, stream))
        stream.flush()
    except (OSError, ValueError):  # nobody reads any more (`| head`), the disk is full, or it is closed
        _silence(stream)


def note(message: str) -> None:
    """For log.txt alone."""
    _LOG.debug(_encodable(message))


def say(message: str) -> None:
    """A line for the person who waits."""
    _LOG.info(_encodable(message))


def warn(message: str) -> None:
    """Prints a warning; work continues."""
    _LOG.warning(_encodable(message))


def error(message: str) -> None:
    """Why something ends here."""
    _LOG.error(_encodable(message))


def _encodable(message: str) -> str:
    """Bytes of the command line that are no text (lone surrogates) as `\\udcff`, which every reader can encode."""
    return message.encode("utf-8", "backslashreplace").decode()


@contextlib.contextmanager
def log_to(path: Path) -> Iterator[None]:
    """Appends every message, with its time, to a file as well.

    Raises:
        UserError: it cannot be opened.
    """
    try:
        handler = _ToFile(path, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise unwritable(path, error) from error
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    _LOG.addHandler(handler)
    try:
        yield
    finally:
        _LOG.removeHandler(handler)
        handler.close()


def _open_streams() -> None:
    """Lets libraries print too: characters that a terminal lacks are replaced, what nobody reads any more is dropped,
    and a stream that was closed leads nowhere. Its number would otherwise be that of the next file that is opened, into
    which others then print.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            with contextlib.suppress(OSError):
                _close_gap(number)
            setattr(sys, name, open(os.devnull, "r" if number == 0 else "w"))  # noqa: SIM115 - for good
        elif number and type(stream) is io.TextIOWrapper:
            setattr(sys, name, _Forgiving(stream))
        elif number and getattr(stream, "errors", None) == "strict" and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # of a test or a notebook


class _Forgiving(io.TextIOWrapper):
    """Standard output or error that nobody need read: `print` never raises, nor does the end of the process."""

    def __init__(self, stream: io.TextIOWrapper) -> None:
        errors = "replace" if stream.errors == "strict" else stream.errors
        super().__init__(stream.buffer, stream.encoding, errors, None, stream.line_buffering, stream.write_through)
        self._stream = stream  # which would close the file at its end

    def write(self, text: str) -> int:
        try:
            return super().write(text)
        except (OSError, ValueError):
            _silence(self)
            return len(text)

    def flush(self) -> None:
        try:
            super().flush()
        except (OSError, ValueError):
            _silence(self)


def _close_gap(number: int) -> None:
    try:
        os.fstat(number)
    except OSError:
        nowhere = os.open(os.devnull, os.O_RDWR)
        if nowhere != number:
            os.dup2(nowhere, number)
            os.close(nowhere)


def _printable(text: str, stream: Any) -> str:
    """The text with a question mark in place of what the stream cannot take."""
    encoding = getattr(stream, "encoding", None) or "utf-8"
    try:
        return text.encode(encoding, "replace").decode(encoding, "replace")
    except LookupError:  # an encoding that Python does not know
        return text.encode("ascii", "replace").decode()


def _silence(stream: Any) -> None:
    """Leads a stream nowhere, so that neither we nor a library at the end of the process write into it again."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
