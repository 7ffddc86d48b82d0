"""Runs a measurement in a process of its own, whose memory and compiler have seen nothing before."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import TypeVar

from apex_lab.errors import UserError

Asked = TypeVar("Asked")
Told = TypeVar("Told")


def in_child(work: Callable[[Asked], Told], asked: Asked) -> Told:
    """`work(asked)`, done by a fresh process; `work` is a function of a module.

    Raises:
        UserError: what the work raised as one, or the process ended without a result (as it does out of memory).
        RuntimeError: the work raised something else; its traceback is on stderr.
    """
    context = multiprocessing.get_context("spawn")
    receive, send = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(work, asked, send), daemon=True)
    process.start()
    send.close()
    try:
        told = receive.recv()
    except EOFError as error:
        process.join()
        if process.exitcode is not None and process.exitcode < 0:
            name = signal.Signals(-process.exitcode).name
            raise UserError(
                f"A measurement was ended by {name}, as happens when memory runs out: "
                "lower data.batch_size, data.frames or data.image_size."
            ) from error
        raise RuntimeError(f"a measurement failed with exit code {process.exitcode}") from error
    finally:
        process.kill()
        process.join()
    if isinstance(told, UserError):
        raise told
    return told


def _serve(work: Callable[[Asked], Told], asked: Asked, send: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent hears it too, and ends this process
    try:
        send.send(work(asked))
    except UserError as error:
        send.send(error)
    send.close()
