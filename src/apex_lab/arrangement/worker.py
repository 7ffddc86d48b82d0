"""A worker process of `pool.Pool`: builds perception once, then runs one scenario after the other."""

from __future__ import annotations

import dataclasses
import signal
import time
import traceback
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

import torch

from apex_lab.arrangement.film import filming
from apex_lab.arrangement.perception import Perception
from apex_lab.arrangement.task import Failure, Setting, Task, digest_of
from apex_lab.base.errors import UserError
from apex_lab.config import components
from apex_lab.runs import checkpoints
from sims.arrangement import episode, scenario
from sims.arrangement.types import Perceive
from sims.errors import SimError


def perceive_of(setting: Setting) -> Perceive:
    """Builds perception.

    Raises:
        UserError: the model cannot do this task, or the checkpoint has changed since the command was started.
    """
    perception = components.build(setting.perception, "perception")
    assert isinstance(perception, Perception)
    inference = None
    if setting.checkpoint is not None:
        if digest_of(setting.checkpoint) != setting.digest:
            raise UserError(f"{setting.checkpoint} has changed meanwhile: run the same command again.")
        inference = checkpoints.load(setting.checkpoint, setting.trusted)["inference"]
    return perception.ready(inference, torch.device(setting.device))


def serve(connection: Connection, setting: Setting) -> None:
    """Receives a `Task`, answers with an `Answer`, until the parent closes the connection or ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends its workers
    torch.set_num_threads(1)
    perceive: Perceive | None = None
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            task: Task = connection.recv()
            try:
                perceive = perceive or perceive_of(setting)
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
