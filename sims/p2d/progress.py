"""Progress of long work with the time left: a bar on a terminal, now and then a plain line elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

PLAIN_INTERVAL_S = 15.0

Advance = Callable[[int], None]


@contextmanager
def progress(title: str, total: int, unit: str, *, shown: bool = True) -> Iterator[Advance]:
    """Shows on stderr how far a piece of work is; yields the function that says that n more units are done.

    Args:
        title: what is being done.
        total: units in all.
        unit: plural, for example "frames".
        shown: False for silence.
    """
    console = Console(stderr=True)
    if not shown:
        yield lambda count: None
    elif console.is_terminal:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TextColumn("{task.completed}/{task.total} " + unit),
            TimeElapsedColumn(),
            TextColumn("left:"),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=console) as bar:
            task = bar.add_task(title, total=total)
            yield lambda count: bar.advance(task, count)
    else:
        lines = _Lines(title, total, unit)
        yield lines.advance
        lines.end()


class _Lines:
    def __init__(self, title: str, total: int, unit: str) -> None:
        self.title, self.total, self.unit = title, total, unit
        self.done = 0
        self.start = self.last = time.monotonic()
        print(f"{title}: {total} {unit}", file=sys.stderr, flush=True)

    def advance(self, count: int) -> None:
        self.done += count
        now = time.monotonic()
        if now - self.last >= PLAIN_INTERVAL_S and self.done < self.total:
            self.last = now
            speed = self.done / (now - self.start)
            left = _duration((self.total - self.done) / speed)
            share = f"{self.done}/{self.total} {self.unit} ({self.done / self.total:.0%})"
            print(f"{self.title}: {share}, {speed:.0f} a second, {left} left", file=sys.stderr, flush=True)

    def end(self) -> None:
        seconds = time.monotonic() - self.start
        speed = self.done / max(seconds, 1e-9)
        print(
            f"{self.title}: {self.done} {self.unit} in {_duration(seconds)} ({speed:.0f} a second)",
            file=sys.stderr,
            flush=True,
        )


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
