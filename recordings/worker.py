"""Worker process of `pool.Pool`: receives (split, index), makes the item, writes it, answers.

Started as `python -m recordings.worker <file descriptor>`: a fresh interpreter that imports none of its parent's
modules but that of the maker, so that threads and GPU memory of a training process are not duplicated.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from recordings.errors import RecordingError
from recordings.files import Arrays
from recordings.layout import Layout
from recordings.plan import Maker

Message = tuple[Any, ...]


@dataclass(frozen=True)
class Job:
    """What every worker of a pool gets: folder, arrays, the noun and the notes of an item, and what makes items."""

    root: Path
    layout: Layout
    item: str
    notes: tuple[str, ...]
    maker: Maker


def main(descriptor: int) -> None:
    """Serves the parent until it closes the connection or ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends its workers
    parent = os.getppid()
    connection: Connection = Connection(descriptor)
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):  # the parent has ended or has released this worker
        # where the parent was killed, the process that resumes must be the only writer
        serve(connection, connection.recv(), parent)


def serve(connection: Connection, job: Job, parent: int) -> None:
    """Sends the facts of the maker, then makes one item after the other and sends the result of each."""
    workshop = Workshop(job, lambda: os.getppid() == parent)
    message = workshop.ready()
    connection.send(message)
    while message[0] != "failed":
        done = workshop.make(*connection.recv())
        if done is None:
            return
        connection.send(done)


class Workshop:
    """Makes and writes items.

    Args:
        job: what to make.
        wanted: asked before an item is written; False if somebody else may write by now.
    """

    def __init__(self, job: Job, wanted: Callable[[], bool] = lambda: True) -> None:
        self.job, self.wanted = job, wanted
        self.arrays: dict[str, Arrays] = {}

    def ready(self) -> Message:
        """("ready", facts) or ("failed", sentence)."""
        try:
            return "ready", self.job.maker.facts()
        except (RecordingError, OSError) as error:
            return "failed", _sentence(error)

    def make(self, split: str, index: int, expected: str | None) -> Message | None:
        """("done", checksum, notes), ("differs", checksum), ("failed", sentence) or ("disk", errno, file).

        None if nothing was written because it is not wanted any more.
        """
        job = self.job
        try:
            item = job.maker.make(split, index)
        except (RecordingError, OSError) as error:
            return "failed", _sentence(error)
        try:
            parts = job.layout.parts(item.arrays, job.item)
        except ValueError as error:  # a mistake in the maker: another attempt would end alike
            return "failed", f"{job.item} {split}/{index} does not fit: {error}"
        notes = {note: item.notes[note] for note in job.notes}
        found = job.layout.checksum(parts)
        if not self.wanted():
            return None
        if expected not in (None, found):
            return "differs", found
        try:
            if split not in self.arrays:
                self.arrays[split] = Arrays(job.root, split, job.layout, writable=True)
            self.arrays[split].write(index, parts)
        except OSError as error:
            return "disk", error.errno, str(error.filename or job.root)
        return "done", found, notes

    def close(self) -> None:
        """Closes all files."""
        for arrays in self.arrays.values():
            arrays.close()


def _sentence(error: RecordingError | OSError) -> str:
    if isinstance(error, RecordingError):
        return str(error)
    where = f"{error.filename} cannot be used" if error.filename else "a file cannot be used"
    return f"{where} ({error.strerror or error}): check its permissions and that disk"


if __name__ == "__main__":
    main(int(sys.argv[1]))
