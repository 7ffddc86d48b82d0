"""Worker process of `pool.Pool`: receives (split, index), simulates, writes, answers.

Started as `python -m sims.p2d.worker <file descriptor>`: a fresh interpreter that imports none of its parent's modules,
so that PyTorch, threads and GPU memory of a training process are not duplicated.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from sims.bullet import INSTALL
from sims.errors import SimError
from sims.p2d.settings import Settings
from sims.p2d.store import Arrays, checksum, to_parts


def main(descriptor: int) -> None:
    """Serves the parent until it closes the connection or ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends its workers
    parent = os.getppid()
    connection: Connection = Connection(descriptor)
    try:
        root, settings, simulator = connection.recv()
        serve(connection, Path(root), Settings.model_validate_json(settings), simulator, parent)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the parent has ended or has released this worker


def serve(connection: Connection, root: Path, settings: Settings, simulator: str, parent: int) -> None:
    """Sends the facts of the simulator, then generates one trajectory after the other.

    Messages sent: ("ready", facts), ("done", checksum, redraws), ("differs", checksum), ("failed", sentence),
    ("disk", errno, file).
    """
    try:
        module = importlib.import_module(simulator)
        facts: dict[str, Any] = module.facts(settings)
    except ModuleNotFoundError as error:
        connection.send(("failed", _not_installed(error)))
        return
    except SimError as error:
        connection.send(("failed", str(error)))
        return
    connection.send(("ready", facts))
    arrays: dict[str, Arrays] = {}
    while True:
        split, index, expected = connection.recv()
        try:
            trajectory = module.simulate(settings, split, index)
        except SimError as error:
            connection.send(("failed", str(error)))
            continue
        parts = to_parts(settings, trajectory)
        found = checksum(parts)
        if os.getppid() != parent:
            return  # the parent was killed: the process that resumes must be the only writer
        if expected not in (None, found):
            connection.send(("differs", found))
            continue
        try:
            if split not in arrays:
                arrays[split] = Arrays(root, split, settings, writable=True)
            arrays[split].write(index, parts)
        except OSError as error:
            connection.send(("disk", error.errno, str(error.filename or root)))
            continue
        connection.send(("done", found, int(trajectory.redraws)))


def _not_installed(error: ModuleNotFoundError) -> str:
    return (
        f"P2D cannot be simulated here because the package {error.name!r} is not installed: install it (for pybullet, "
        f"{INSTALL}), or make the data on another machine and copy the folder"
    )


if __name__ == "__main__":
    main(int(sys.argv[1]))
