"""Progress of long work with the time left: a bar on a terminal, a plain line every 15 seconds elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from recordings.streams import say

PLAIN_INTERVAL_S = 15.0


@contextmanager
def progress(title: str, total: int, unit: str, *, shown: bool = True) -> Iterator[Callable[[int], None]]:
    """Show progress on stderr; yields a function that adds n to the number of finished units.

    Args:
        title: the work's name.
        total: number of units.
        unit: plural, for example "frames".
        shown: False for silence.
    """
    console = Console(stderr=True)
    plain = shown and not console.is_terminal
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.completed}/{task.total} " + unit),
        TimeElapsedColumn(),
        TextColumn("left:"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, get_time=time.monotonic, disable=plain or not shown) as bar:
        bar.add_task(title, total=total)
        (task,) = bar.tasks
        printed = time.monotonic()

        def advance(count: int) -> None:
            nonlocal printed
            bar.advance(task.id, count)
            if plain and not task.finished and time.monotonic() - printed >= PLAIN_INTERVAL_S:
                printed = time.monotonic()
                left = "unknown time" if task.time_remaining is None else timedelta(seconds=round(task.time_remaining))
                say(f"{title}: {task.completed}/{total} {unit} ({task.percentage:.0f}%), {left} left", error=True)

        if plain:
            say(f"{title}: {total} {unit}", error=True)
        yield advance
        if plain:
            say(f"{title}: {task.completed} {unit} in {timedelta(seconds=round(task.elapsed or 0))}", error=True)
