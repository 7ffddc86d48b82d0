"""Worker process of `pool.Pool`: receives (split, index), makes the item, writes it, answers.

Started as `python -m recordings.worker <file descriptor>`: a fresh interpreter that imports none of its parent's
modules but that of the maker, so that threads and GPU memory of a training process are not duplicated.
"""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

from recordings.errors import RecordingError
from recordings.files import Arrays
from recordings.layout import Layout
from recordings.plan import Maker


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
        serve(connection, connection.recv(), parent)


def serve(connection: Connection, job: Job, parent: int) -> None:
    """Sends the facts of the maker, then makes one item after the other.

    Messages sent: ("ready", facts), ("done", checksum, notes), ("differs", checksum), ("failed", sentence),
    ("disk", errno, file).
    """
    try:
        facts = job.maker.facts()
    except (RecordingError, OSError) as error:
        connection.send(("failed", _sentence(error)))
        return
    connection.send(("ready", facts))
    arrays: dict[str, Arrays] = {}
    while True:
        split, index, expected = connection.recv()
        try:
            item = job.maker.make(split, index)
        except (RecordingError, OSError) as error:
            connection.send(("failed", _sentence(error)))
            continue
        parts = job.layout.parts(item.arrays, job.item)
        notes = {note: item.notes[note] for note in job.notes}
        found = job.layout.checksum(parts)
        if os.getppid() != parent:
            return  # the parent was killed: the process that resumes must be the only writer
        if expected not in (None, found):
            connection.send(("differs", found))
            continue
        try:
            if split not in arrays:
                arrays[split] = Arrays(job.root, split, job.layout, writable=True)
            arrays[split].write(index, parts)
        except OSError as error:
            connection.send(("disk", error.errno, str(error.filename or job.root)))
            continue
        connection.send(("done", found, notes))


def _sentence(error: RecordingError | OSError) -> str:
    if isinstance(error, RecordingError):
        return str(error)
    where = f"{error.filename} cannot be used" if error.filename else "a file cannot be used"
    return f"{where} ({error.strerror or error}): check its permissions and that disk"


if __name__ == "__main__":
    main(int(sys.argv[1]))
