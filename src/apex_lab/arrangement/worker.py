"""A worker process of `pool.Pool`: builds perception once, then runs one scenario after the other."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import signal
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch

from apex_lab.arrangement.film import filming
from apex_lab.arrangement.perception import Perception
from apex_lab.base.errors import UserError
from apex_lab.config import components
from apex_lab.runs import checkpoints
from sims.arrangement import episode, scenario
from sims.arrangement.settings import Settings
from sims.arrangement.types import Perceive
from sims.errors import SimError


@dataclass(frozen=True)
class Task:
    """One scenario: number of objects, index, and where its video goes (None: no video)."""

    objects: int
    index: int
    film: Path | None = None

    @property
    def name(self) -> str:
        """As on the command line: "4/17"."""
        return f"{self.objects}/{self.index}"


@dataclass(frozen=True)
class Setting:
    """What all scenarios of a command share. It is sent to other processes, so it holds no model.

    Attributes:
        perception: node of a `Perception`.
        checkpoint: file with the model's weights; None where none is needed.
        digest: SHA-256 of that file.
        trusted: as of `checkpoints.load`.
        device: name of the device that models run on.
        world: settings of the simulation.
        seed: of the scenarios.
    """

    perception: Mapping[str, Any]
    checkpoint: Path | None
    digest: str | None
    trusted: bool
    device: str
    world: Settings
    seed: int

    def perceive(self) -> Perceive:
        """Builds perception.

        Raises:
            UserError: the model cannot do this task, or the checkpoint has changed since the command was started.
        """
        perception = components.build(self.perception, "perception")
        assert isinstance(perception, Perception)
        inference = None
        if self.checkpoint is not None:
            if digest_of(self.checkpoint) != self.digest:
                raise UserError(f"{self.checkpoint} has changed meanwhile: run the same command again.")
            inference = checkpoints.load(self.checkpoint, self.trusted)["inference"]
        return perception.ready(inference, torch.device(self.device))


@dataclass(frozen=True)
class Failure:
    """Why a scenario has no outcome.

    Attributes:
        reason: on one line.
        details: a traceback.
        final: every scenario would fail so.
    """

    reason: str
    details: str = ""
    final: bool = False


Answer = dict[str, Any] | Failure
"""An outcome as plain data (`sims.arrangement.types.Outcome`, and `seconds` of processor time), or a failure."""

Serve = Callable[[Connection, Setting], None]


def digest_of(file: Path) -> str:
    """SHA-256 of a file, in hex."""
    with open(file, "rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def serve(connection: Connection, setting: Setting) -> None:
    """Receives a `Task`, answers with an `Answer`, until the parent closes the connection or ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends its workers
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)  # PyBullet greets there
    torch.set_num_threads(1)
    perceive: Perceive | None = None
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            task: Task = connection.recv()
            try:
                perceive = perceive or setting.perceive()
                connection.send(arranged(task, setting, perceive))
            except (UserError, SimError) as error:
                connection.send(Failure(str(error), final=True))
            except (EOFError, BrokenPipeError, ConnectionResetError):
                raise
            except Exception as error:  # noqa: BLE001 - the parent reports it; other scenarios may still run
                connection.send(Failure(f"{type(error).__name__}: {error}", traceback.format_exc()))


def arranged(task: Task, setting: Setting, perceive: Perceive) -> dict[str, Any]:
    """Runs a scenario; its outcome as plain data."""
    began = time.process_time()
    drawn = scenario.draw(setting.seed, task.objects, task.index, setting.world)
    if task.film is None:
        outcome = episode.run(drawn, perceive, setting.world)
    else:
        with filming(task.film, task.name, setting.world.video_fps) as on_frame:
            outcome = episode.run(drawn, perceive, setting.world, on_frame=on_frame)
    return {**dataclasses.asdict(outcome), "seconds": time.process_time() - began}
