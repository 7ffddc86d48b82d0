"""Runs a measurement in a process of its own, whose memory and compiler have seen nothing before."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import TypeVar

from apex_lab.base import faults
from apex_lab.base.errors import UserError

Asked = TypeVar("Asked")
Told = TypeVar("Told")


def in_child(work: Callable[[Asked], Told], asked: Asked) -> Told:
    """`work(asked)`, done by a fresh process; `work` is a function of a module.

    Raises:
        UserError: what the work raised, or the process was ended (as it is out of memory).
        RuntimeError: the process ended by itself without a result.
    """
    context = multiprocessing.get_context("spawn")
    receive, send = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(work, asked, send), daemon=True)
    process.start()
    send.close()
    try:
        told = receive.recv()
    except EOFError as error:
        raise death(process, "A measurement") from error
    finally:
        process.kill()
        process.join()
    if isinstance(told, UserError):
        raise told
    return told


def death(process: BaseProcess, what: str) -> UserError | RuntimeError:
    """What is to be raised of a process that ended without a result.

    A signal is the user's business, as when memory runs out; else the process has written a traceback to stderr.
    """
    process.join()
    if process.exitcode is not None and process.exitcode < 0:
        name = signal.Signals(-process.exitcode).name
        return UserError(
            f"{what} was ended by {name}, as happens when memory runs out: "
            "lower clips.batch_size, clips.frames or data.image_size."
        )
    return RuntimeError(f"{what} failed with exit code {process.exitcode}")


def _serve(work: Callable[[Asked], Told], asked: Asked, send: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent receives it too, and ends this process
    try:
        with faults.net():
            found = work(asked)
        send.send(found)
    except UserError as error:
        send.send(UserError(str(error)))  # without its cause, which may not travel
    send.close()
