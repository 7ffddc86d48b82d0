"""Progress and time left of long work: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from apex_lab.base import console


class Meter:
    """Shows progress while it is open.

    Args:
        title: the unit of work.
        total: how many there are; None: not known.
        done: how many were done before.
        seconds: between two lines where there is no terminal.
    """

    def __init__(self, title: str, total: int | None, done: int = 0, seconds: float = 15.0) -> None:
        self._title, self._total, self._seconds = title, total, seconds
        self._first, self._began = done, time.monotonic()
        self._told = self._began
        self._bar: Progress | None = None
        if sys.stderr.isatty():
            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
            self._bar = Progress(*columns, TextColumn("{task.fields[note]}"), console=Console(stderr=True))
            self._task = self._bar.add_task(title, total=total, completed=done, note="")

    def __enter__(self) -> Meter:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def due(self) -> bool:
        """Whether `show` would show anything now, so that a note costs nothing when it would not."""
        return self._bar is not None or time.monotonic() - self._told >= self._seconds

    def restart(self, done: int) -> None:
        """Measures speed from here on; what came before was slower."""
        self._first, self._began = done, time.monotonic()

    def show(self, done: int, note: str = "") -> None:
        """Shows how many are done, if it is time to."""
        if self._bar is not None:
            self._bar.update(self._task, completed=done, note=note)
        elif self.due():
            self._told = time.monotonic()
            console.say(", ".join([*self._state(done), *([note] if note else []), *self._left(done)]))

    def _state(self, done: int) -> list[str]:
        return [f"{self._title} {done}" if self._total is None else f"{self._title} {done} of {self._total}"]

    def _left(self, done: int) -> list[str]:
        if self._total is None:
            return []
        left = (self._told - self._began) / max(done - self._first, 1) * (self._total - done)
        return [f"{readable(max(left, 0))} left"]


def readable(seconds: float) -> str:
    """A duration in the unit a person would use."""
    for size, unit in ((86400.0, "days"), (3600.0, "hours"), (60.0, "minutes")):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}" if seconds < 10 * size else f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} seconds"
