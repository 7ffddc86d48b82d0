"""The commands of missing runs."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from apex_lab.tables.build import Built
from apex_lab.tables.choose import Choice, Group, Version, command_words
from apex_lab.tables.found import run_words
from apex_lab.tables.rows import Line, Options

TRAIN = "python -m apex_lab.train"
ARRANGE = "python -m apex_lab.arrange"
ABSENT = "not in this version"


@dataclass(frozen=True)
class Command:
    """A command line and the remark on it."""

    text: str
    remarks: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.text}  # {'; '.join(self.remarks)}"


def missing_runs(
    tables: Sequence[Built],
    choices: Mapping[tuple[str, str | None], Choice],
    options: Options,
    asked: Iterable[str],
    version: Version,
    outputs: str,
    paths: Sequence[str],
) -> list[Command]:
    """The commands for everything that the tables lack, trainings first.

    Args:
        tables: all of them.
        choices: the runs of each row.
        options: what was asked for.
        asked: names of run folders that were asked for.
        version: what this version can run.
        outputs: folder of the runs.
        paths: words of the command line for the folders of runs and data.
    """
    rows: dict[tuple[str, str | None], dict[str, Line]] = {}
    for table in tables:
        for line in table.lines:
            rows.setdefault(line.row.run, {})[table.number] = line
    commands = []
    for row, lines in rows.items():
        command = _training(row, lines, choices[row].group, options, set(asked), version, paths)
        commands += [command] if command else []
    for table in tables:
        if table.source == "arrangement":
            for line in table.lines:
                commands += _arrangements(line, choices[line.row.run].group, options, version, table.number, outputs)
    return commands


def _training(
    row: tuple[str, str | None],
    lines: Mapping[str, Line],
    group: Group | None,
    options: Options,
    asked: set[str],
    version: Version,
    paths: Sequence[str],
) -> Command | None:
    """The command that completes a row; None where nothing is missing."""
    first = next(iter(lines.values()))
    wanted = sorted({seed for line in lines.values() for seed in line.wanted})
    damaged = [seed for seed, run in group.runs.items() if run.state == "damaged"] if group else []
    seeds = sorted({*damaged, *(seed for line in lines.values() for seed in (*line.missing, *line.unfinished))})
    remarks = [f"{first.label}, table{'s' if len(lines) > 1 else ''} {', '.join(lines)}"]
    changes: tuple[str, ...] = ()
    if group is not None and group.name in asked:
        changes = group.changes
    elif group is not None and group.changes and not group.current:
        seeds = wanted
        remarks.append("without the changed values")
    elif group is not None and group.current is False:
        remarks.append(f"its other seeds have another configuration; seed={_joined(wanted)} makes the whole row again")
    if not seeds:
        return None
    if not version.has(*row):
        remarks.append(ABSENT)
    naming = command_words(*row, options.data, options.scale)
    split = 1 if row[1] is None else 2
    words = [*naming[:split], f"seed={_joined(seeds)}", *naming[split:], *changes, *paths]
    return Command(_typed(TRAIN, [*words, *(["-m"] if len(seeds) > 1 else [])]), tuple(remarks))


def _arrangements(
    line: Line, group: Group | None, options: Options, version: Version, number: str, outputs: str
) -> list[Command]:
    """One command per seed whose results of the arrangement task are missing."""
    lacking = len(line.wanted) - len(line.counted)
    runs = group.runs if group else {}
    useless = {seed for seed, run in runs.items() if run.failure and line.row.model in options.exclude_failed}
    free = [seed for seed in dict.fromkeys([*line.wanted, *sorted(runs)]) if seed not in {*line.counted, *useless}]
    name = group.name if group else f"{run_words(*line.row.run, options.data, options.scale)}_*"
    remarks = [f"{line.label}, table {number}"]
    if not version.arrange or not version.has(*line.row.run):
        remarks.append(ABSENT)
    words = [f"checkpoint={outputs}/{name}/seed_{seed}" for seed in free[: max(0, lacking)]]
    return [Command(_typed(ARRANGE, [word]), tuple(remarks)) for word in words]


def _joined(seeds: Iterable[int]) -> str:
    return ",".join(str(seed) for seed in seeds)


def _typed(program: str, words: Sequence[str]) -> str:
    return " ".join([program, *(shlex.quote(word) for word in words)])
