"""How far runs are: waiting, running, lost, paused, interrupted, failed with their reasons, finished.

python -m apex_lab.status +sweep=ablations scale=cpu   the jobs of a sweep; any words of apex_lab.train name its jobs
python -m apex_lab.status                              every run in the folder of runs
python -m apex_lab.status +sweep=paper --once          once, not again and again (so without a terminal, too)
python -m apex_lab.status +sweep=paper --json          once, for programs
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from itertools import groupby

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from apex_lab.base import console as terminal
from apex_lab.base.progress import readable
from apex_lab.config.composition import outputs_folder
from apex_lab.config.reader import Reader, ending
from apex_lab.runs.listed import listed
from apex_lab.runs.progress import Overview, Progress, found, overview
from apex_lab.runs.state import State

INTERVAL = 2.0
"""Seconds between two looks."""

STYLES: dict[State, str] = {
    "waiting": "dim",
    "running": "cyan",
    "lost": "yellow",
    "paused": "yellow",
    "interrupted": "yellow",
    "failed": "red",
    "damaged": "red",
    "finished": "green",
}
"""State -> style; in the order in which they are counted."""

ALIKE: tuple[State, ...] = ("waiting", "finished")
"""States in which the seeds of a configuration share a line."""


def main() -> None:
    """Entry point: `python -m apex_lab.status`."""
    reader = Reader("status", __doc__ or "")
    reader.add_argument("--once", action="store_true", help="print once and end")
    reader.add_argument("--json", action="store_true", help="print JSON once and end")
    with ending():
        asked = reader.asked()
        look = looking(asked.words, asked.config_dir)
        if asked.json:
            terminal.say(json.dumps(look().as_json(), indent=2))
        elif asked.once or not sys.stdout.isatty():
            Console(file=sys.stdout).print(drawn(look()))
        else:
            with suppress(KeyboardInterrupt):
                watch(look, Console(file=sys.stdout))


def looking(words: Sequence[str], config_dir: str | None = None) -> Callable[[], Overview]:
    """What looks at the jobs of a command line, again with every call; without choices, at all runs in a folder.

    Raises:
        UserError: words that no run can have.
    """
    if all(word.lstrip("+").startswith("paths.") for word in words):
        outputs = outputs_folder(words)
        if words and not outputs.exists():
            terminal.warn(f"The folder {outputs} (paths.outputs) does not exist.")
        last: list[Overview | None] = [None]

        def look() -> Overview:
            last[0] = seen = found(outputs, last[0])
            return seen

        return look
    jobs = listed(words, config_dir)

    def look_again() -> Overview:
        jobs[:] = [job if job.state.state == "finished" else job.again() for job in jobs]
        return overview(jobs)

    return look_again


def watch(look: Callable[[], Overview], console: Console) -> None:
    """Shows how far the jobs are until all have ended."""
    with Live(console=console, auto_refresh=False, vertical_overflow="ellipsis") as live:
        while True:
            seen = look()
            live.update(drawn(seen, console.size.height - 8), refresh=True)
            if seen.ended:
                break
            time.sleep(INTERVAL)
    if len(_lines(seen.jobs)) > console.size.height - 8:
        console.print(drawn(seen))


def drawn(seen: Overview, most: int | None = None) -> RenderableType:
    """The sums, which a small terminal shows too, and the jobs as a table.

    Args:
        seen: what to draw.
        most: lines at most; of more, those of jobs that wait or are finished are left out first.
    """
    if not seen.jobs:
        return Text("There are no runs.")
    lines, hidden = _lines(seen.jobs), 0
    if most is not None and len(lines) > most:
        shown = [line for line in lines if line[0].state.state not in ALIKE][: max(1, most)]
        hidden, lines = len(lines) - len(shown), shown
    table = Table(box=None, pad_edge=False)
    table.add_column("run", overflow="fold")
    table.add_column("seed", overflow="fold", max_width=9)
    table.add_column("state", no_wrap=True)
    table.add_column("steps", justify="right", no_wrap=True)
    table.add_column("to go", justify="right", no_wrap=True)
    for line in lines:
        job = line[0]
        style = STYLES[job.state.state]
        table.add_row(
            Text(job.name, style="dim" if style == "dim" else ""),
            _ranges([each.seed for each in line]),
            Text(job.state.state, style=style),
            _steps(job),
            _left(line),
        )
    parts: list[RenderableType] = [table, *_reasons(lines)]
    if hidden:
        parts.append(Text(f"... {hidden} more lines; --once prints all", style="dim"))
    return Group(Text(summary(seen)), Text(), *parts)


def summary(seen: Overview) -> str:
    """The jobs counted, hours spent and hours to go."""
    counts = ", ".join(f"{seen.counts[state]} {state}" for state in STYLES if seen.counts[state])
    total = f"{len(seen.jobs)} job{'' if len(seen.jobs) == 1 else 's'}: {counts}."
    spent = f"Training: {readable(seen.spent)} spent"
    if seen.ended:
        return f"{total}\n{spent}."
    known = f"about {readable(seen.left)} to go, one run at a time"
    if not seen.unknown:
        return f"{total}\n{spent}, {known}."
    jobs = f"{seen.unknown} job{'' if seen.unknown == 1 else 's'}"
    why = "no run of the same configuration tells how long they take"
    open_jobs = sum(job.left is None or job.left > 0 for job in seen.jobs)
    rest = f"for the others; unknown for {jobs}, since {why}"
    return f"{total}\n{spent}, {f'{known}, {rest}' if open_jobs > seen.unknown else f'unknown to go, since {why}'}."


def _lines(jobs: Iterable[Progress]) -> list[list[Progress]]:
    """Jobs that share a line: seeds of one configuration that wait or are finished."""
    lines: list[list[Progress]] = []
    for _, seeds in groupby(jobs, key=lambda job: job.name):
        alike: dict[State, list[Progress]] = {}
        for job in seeds:
            state = job.state.state
            if state in ALIKE and state in alike:
                alike[state].append(job)
                continue
            lines.append([job])
            alike[state] = lines[-1]
    return lines


def _reasons(lines: Iterable[Sequence[Progress]]) -> list[Text]:
    """Why runs ended early, a paragraph each."""
    jobs = [line[0] for line in lines if line[0].state.reason]
    told = [Text(f"{job.name}, seed {job.seed}: {job.state.reason}", STYLES[job.state.state]) for job in jobs]
    return [Text(), *told] if told else []


def _ranges(seeds: Sequence[int]) -> str:
    """ "0-3,7"."""
    parts: list[list[int]] = []
    for seed in sorted(set(seeds)):
        if parts and seed == parts[-1][-1] + 1:
            parts[-1].append(seed)
        else:
            parts.append([seed])
    return ",".join(str(part[0]) if len(part) == 1 else f"{part[0]}-{part[-1]}" for part in parts)


def _steps(job: Progress) -> str:
    if job.max_steps == 0:
        return ""
    if job.max_steps is None or job.state.state == "finished":
        return str(job.steps)
    return f"{job.steps}/{job.max_steps}"


def _left(line: Sequence[Progress]) -> str:
    if line[0].state.state in ("finished", "failed", "damaged") or line[0].max_steps == 0:
        return ""
    known = [job.left for job in line if job.left is not None]
    return readable(sum(known)) if len(known) == len(line) else "unknown"


if __name__ == "__main__":
    main()
