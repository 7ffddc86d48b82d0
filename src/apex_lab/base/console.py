"""Messages to the person at the terminal and to a run's log.txt."""

from __future__ import annotations

import contextlib
import logging
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

_LOG = logging.getLogger("apex_lab")


class _ToStream(logging.Handler):
    """Messages to stdout, warnings and errors to stderr, whichever streams these are at that moment."""

    def emit(self, record: logging.LogRecord) -> None:
        stream = sys.stderr if record.levelno >= logging.WARNING else sys.stdout
        stream.write(self.format(record) + "\n")
        stream.flush()


def setup() -> None:
    """Sends messages to the terminal and quietens libraries that report on themselves."""
    if not any(isinstance(handler, _ToStream) for handler in _LOG.handlers):
        _LOG.addHandler(_ToStream(logging.INFO))
    _LOG.setLevel(logging.DEBUG)
    _LOG.propagate = False
    for name in ("lightning.pytorch", "lightning.fabric", "lightning"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings("ignore", message=".*No device id is provided.*")
    warnings.filterwarnings("ignore", message=".*have no `val_dataloader`.*")
    warnings.filterwarnings("ignore", message=".*treespec, LeafSpec.*")
    warnings.filterwarnings("ignore", message=".*GPU available but not used.*")


def note(message: str) -> None:
    """For log.txt alone."""
    _LOG.debug(message)


def say(message: str) -> None:
    """A line for the person who waits."""
    _LOG.info(message)


def warn(message: str) -> None:
    """Prints a warning; work continues."""
    _LOG.warning(message)


def error(message: str) -> None:
    """Why something ends here."""
    _LOG.error(message)


@contextlib.contextmanager
def log_to(path: Path) -> Iterator[None]:
    """Appends every message, with its time, to a file as well."""
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    _LOG.addHandler(handler)
    try:
        yield
    finally:
        _LOG.removeHandler(handler)
        handler.close()
