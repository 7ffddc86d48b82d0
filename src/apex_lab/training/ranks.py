"""Several processes that train one model: Lightning's DDP, with the run folder in the hands of rank 0.

On one machine rank 0 starts the others itself. Under torchrun they are started from outside, and the
environment gives each its rank. Only rank 0 takes the run's lock and writes files.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from apex_lab.base import interrupts
from apex_lab.base.errors import UserError
from apex_lab.base.files import replacing
from apex_lab.base.interrupts import Interrupted

JOB = "APEX_LAB_JOB"
"""Environment variable of a process that rank 0 has started: the file with the job."""


@dataclass(frozen=True)
class Ranks:
    """Which process this is, of how many."""

    rank: int = 0
    world: int = 1


def given() -> Ranks | None:
    """Rank and world size that torchrun, or rank 0 of this package, sets in the environment; None without them."""
    rank, world = os.environ.get("RANK", ""), os.environ.get("WORLD_SIZE", "")
    return Ranks(int(rank), int(world)) if rank.isdecimal() and world.isdecimal() else None


def check_given(outside: Ranks | None, devices: int, nodes: int) -> None:
    """Compares what a launcher has started with what is asked for.

    Raises:
        UserError: they differ, so processes would wait for others that never come.
    """
    if outside is not None and outside.world != devices * nodes:
        raise UserError(
            f"The environment says that {outside.world} processes were started (WORLD_SIZE), but trainer.devices = "
            f"{devices} and trainer.num_nodes = {nodes} ask for {devices * nodes}: set them alike, or unset RANK and "
            "WORLD_SIZE."
        )


@contextlib.contextmanager
def started(job: dict[str, Any], devices: int, nodes: int, folder: Path) -> Iterator[Ranks]:
    """For rank 0: the other ranks, which end with this block where they were started here.

    Args:
        job: what `apex_lab.training.worker` needs, plain values.
        devices: processes on this machine.
        nodes: machines.
        folder: the run's, where ranks that a launcher has started find the job.

    Raises:
        UserError: several nodes without a launcher that gives each its rank.
    """
    outside = given()
    if outside is not None:
        file = job_file(folder)
        with replacing(file) as opened:
            torch.save(job, opened)
        try:
            yield outside
        finally:
            file.unlink(missing_ok=True)
        return
    if nodes > 1:
        raise UserError(
            f"trainer.num_nodes = {nodes} needs a launcher that starts one process per device, such as torchrun, "
            "on every node."
        )
    if devices == 1:
        yield Ranks()
        return
    common = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(_free_port()), "WORLD_SIZE": str(devices)}
    threads = {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", str(max(1, torch.get_num_threads() // devices)))}
    with tempfile.TemporaryDirectory(prefix="apex_lab_ranks_") as aside:
        file = Path(aside) / "job.pt"
        with replacing(file) as opened:
            torch.save(job, opened)
        workers: list[subprocess.Popen[bytes]] = []
        before = dict(os.environ)
        try:
            for rank in range(1, devices):
                own = {"RANK": str(rank), "LOCAL_RANK": str(rank), "NODE_RANK": "0", JOB: str(file)}
                command = [sys.executable, "-m", "apex_lab.training.worker"]
                workers.append(
                    subprocess.Popen(command, env={**os.environ, **common, **threads, **own}, stdin=subprocess.PIPE)
                )
            os.environ.update({**common, "RANK": "0", "LOCAL_RANK": "0", "NODE_RANK": "0"})
            try:
                yield Ranks(0, devices)
            except RuntimeError as error:
                signum = interrupts.asked()
                if signum is not None:  # it may have reached the others too
                    raise Interrupted(signum) from error
                raise _death(workers) or error from error
            for worker in workers:
                worker.wait(timeout=60)
        finally:
            for worker in workers:
                worker.kill()
                worker.wait()
            os.environ.clear()
            os.environ.update(before)


def _death(workers: Sequence[subprocess.Popen[bytes]]) -> UserError | None:
    """What ended the processes that are gone, which the others only notice by a closed connection."""
    time.sleep(1.0)
    for rank, worker in enumerate(workers, start=1):
        code = worker.poll()
        if code is not None:
            how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            return UserError(
                f"The process of rank {rank} ended with {how}: see its messages above; the same command resumes."
            )
    return None


def job_file(folder: Path) -> Path:
    """Where rank 0 leaves the job for ranks that a launcher has started, which see the same folder."""
    return folder / f".job_{os.environ.get('TORCHELASTIC_RUN_ID', 'run')}_{os.environ.get('MASTER_PORT', '')}.pt"


def wait_for(file: Path, seconds: float = 3600.0) -> Path:
    """Waits until rank 0 has made the data and left the job.

    Raises:
        UserError: it did not.
    """
    began = time.monotonic()
    while not file.exists():
        if time.monotonic() - began > seconds:
            raise UserError(f"Rank 0 has not left {file} within {seconds / 60:.0f} minutes: look at its messages.")
        time.sleep(0.2)
    return file


def end_with_parent() -> None:
    """Ends this process when rank 0 dies: its end of our standard input is closed then."""

    def watch() -> None:
        os.read(0, 1)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def _free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])
