"""The commands of missing runs."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

from apex_lab.tables.build import Built
from apex_lab.tables.configurations import Configuration
from apex_lab.tables.rows import Line

TRAIN = "python -m apex_lab.train"
ARRANGE = "python -m apex_lab.arrange"
RETRY = "hydra.sweeper.retry_failed=true"


@dataclass(frozen=True)
class Command:
    """A command line and the remark on it."""

    text: str
    remarks: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.text}  # {'; '.join(self.remarks)}"


def missing_runs(
    tables: Sequence[Built],
    words: Sequence[str] | None,
    exclude_failed: Collection[str],
    config_dir: str | None = None,
) -> list[Command]:
    """The commands for everything that the tables lack: all of it at once, then row by row, trainings first.

    Args:
        tables: all of them.
        words: those that name the jobs, where all jobs are in the tables.
        exclude_failed: models whose failed seeds do not count.
        config_dir: a further folder of configuration files.
    """
    options = ["--config-dir", config_dir] if config_dir else []
    rows: dict[str, dict[str, Line]] = {}
    for table in tables:
        for line in table.lines:
            rows.setdefault(line.configuration.name, {})[table.number] = line
    found = [(_lacking(lines.values()), lines) for lines in rows.values()]
    trainings = [_training(seeds, lines, options) for seeds, lines in found if seeds]
    commands = []
    if words is not None and len(trainings) > 1:
        retry = any(_has_failed(lines, seeds) for seeds, lines in found)
        text = _typed(TRAIN, [*words, *([RETRY] if retry else []), *options, "-m"])
        commands = [Command(text, ("all that is missing",))]
    commands += trainings
    for table in tables:
        if table.source == "arrangement":
            for line in table.lines:
                commands += _arrangements(line, exclude_failed, table.number)
    return commands


def _lacking(lines: Iterable[Line]) -> list[int]:
    """Seeds of a configuration that are to be run or resumed."""
    seeds: set[int] = set()
    for line in lines:
        damaged = [seed for seed, run in line.configuration.runs.items() if run.state == "damaged"]
        seeds |= {*line.missing, *line.unfinished, *damaged}
    return sorted(seeds)


def _has_failed(lines: dict[str, Line], seeds: Sequence[int]) -> bool:
    """Whether one of the seeds failed, which a sweep does not try again unless asked to."""
    runs = next(iter(lines.values())).configuration.runs
    records = [runs[seed].record for seed in seeds if seed in runs]
    return any(
        record is not None and record.status == "failed" and record.outcome in (None, "failed") for record in records
    )


def _training(seeds: Sequence[int], lines: dict[str, Line], options: Sequence[str]) -> Command:
    """The command that completes a row."""
    first = next(iter(lines.values()))
    several = len(seeds) > 1
    words = _seeded(first.configuration, seeds)
    retry = [RETRY] if several and _has_failed(lines, seeds) else []
    remark = f"{first.label}, table{'s' if len(lines) > 1 else ''} {', '.join(lines)}"
    return Command(_typed(TRAIN, [*words, *retry, *options, *(["-m"] if several else [])]), (remark,))


def _seeded(configuration: Configuration, seeds: Sequence[int]) -> list[str]:
    """The words of a configuration's jobs with other seeds."""
    words = list(configuration.jobs[min(configuration.jobs)])
    seed = f"seed={','.join(map(str, seeds))}"
    if not any(word.startswith("seed=") for word in words):
        return [*words, *([seed] if seeds != [0] else [])]
    return [seed if word.startswith("seed=") else word for word in words]


def _arrangements(line: Line, exclude_failed: Collection[str], number: str) -> list[Command]:
    """One command per seed whose results of the arrangement task are missing."""
    configuration = line.configuration
    lacking = len(line.wanted) - len(line.counted)
    useless = {s for s, run in configuration.runs.items() if run.failure and line.row.model in exclude_failed}
    seeds = dict.fromkeys([*line.wanted, *configuration.seeds])
    free = [seed for seed in seeds if seed not in {*line.counted, *useless}]
    remarks = (f"{line.label}, table {number}",)
    folders = [configuration.folders[seed] for seed in free[: max(0, lacking)]]
    return [Command(_typed(ARRANGE, [f"checkpoint={folder}"]), remarks) for folder in folders]


def _typed(program: str, words: Sequence[str]) -> str:
    return " ".join([program, *(shlex.quote(word) for word in words)])
