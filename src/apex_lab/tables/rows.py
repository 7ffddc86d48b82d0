"""Rows as values: which seeds count, mean and deviation of every cell, and remarks on them."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from apex_lab.base.errors import UserError
from apex_lab.tables.configurations import Configuration
from apex_lab.tables.definition import Column, Published, Row, Specification, Table
from apex_lab.tables.found import Protocol, SeedRun, and_list, read_arrangement, read_failures

DDOF = 1
"""Seeds are a sample: deviations divide by n - 1 (metrics.md section 3)."""

TRACKING = "tracking"
"""Key of the column with yes or no."""


@dataclass(frozen=True)
class Options:
    """What is asked for; see conf/tables.yaml."""

    exclude_failed: Collection[str]
    published: bool
    yardsticks: bool
    arrangement_mean: Literal["scenario", "object"]


@dataclass(frozen=True)
class Summary:
    """Mean and standard deviation of n values; the mean of none is NaN, the deviation of fewer than two None."""

    n: int
    mean: float
    std: float | None


def summarise(values: Iterable[float]) -> Summary:
    """Mean and sample deviation of those values that are finite."""
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return Summary(0, math.nan, None)
    mean = math.fsum(finite) / len(finite)
    squares = math.fsum((value - mean) ** 2 for value in finite)
    std = math.sqrt(squares / (len(finite) - DDOF)) if len(finite) > DDOF else None
    return Summary(len(finite), mean, std)


def rounded(value: float, decimals: int) -> str:
    """A number as it is printed: no negative zero."""
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if float(text) == 0 else text


@dataclass(frozen=True)
class Cell:
    """One entry of a table.

    Attributes:
        values: seed -> unrounded values (one, or one per scenario of table 4), failed seeds that do not count included.
        summary: over the seeds that count; None where no run has this column.
        over_all: over all seeds with results.
        published: what the paper prints.
        best: whether it is the best of its column.
    """

    values: Mapping[int, tuple[float, ...]]
    summary: Summary | None
    over_all: Summary | None
    published: Published | None
    best: bool = False


@dataclass(frozen=True)
class Line:
    """One row.

    Attributes:
        row: its specification.
        configuration: what was run.
        name: what the paper calls it.
        label: its name, without an asterisk; what differs from the paper's data, scale and settings is in it.
        told: what differs from the paper's data, scale and settings.
        latex: the name in LaTeX, where that differs, without what differs.
        asterisk: whether a footnote marked * belongs to it.
        tracking: whether its components keep identities; None where nothing tells.
        counted: seeds in the means.
        excluded: seed -> why it does not count though it may have results (failed-seed rule).
        failed: seed -> why it has no results: failed by the rule, or damaged.
        unfinished: seed -> the reason in its record.
        left_out: seed -> why its results cannot stand beside the others.
        missing: seeds that were never started.
        wanted: seeds of its jobs that the table needs.
        candidate: whether it competes for bold.
        protocol: of its scores.
        cells: key of the column -> entry.
        notes: remarks on it.
    """

    row: Row
    configuration: Configuration
    name: str
    label: str
    told: tuple[str, ...]
    latex: str | None
    asterisk: bool
    tracking: bool | None
    counted: tuple[int, ...]
    excluded: dict[int, str]
    failed: dict[int, str]
    unfinished: dict[int, str]
    left_out: dict[int, str]
    missing: tuple[int, ...]
    wanted: tuple[int, ...]
    candidate: bool
    protocol: Protocol | None
    cells: dict[str, Cell]
    notes: tuple[str, ...]

    @property
    def seeds(self) -> str:
        """How many seeds count, as "3 of 4" where some do not."""
        known = {*self.counted, *self.excluded, *self.failed, *self.unfinished, *self.left_out}
        total = max(len(self.wanted), len(known))
        return str(total) if len(self.counted) == total else f"{len(self.counted)} of {total}"


@dataclass(frozen=True)
class _Content:
    """The content of a table: the results of each seed of each row."""

    results: Mapping[int, Mapping[str, tuple[float, ...]]] = field(default_factory=dict)
    faults: Mapping[int, str] = field(default_factory=dict)


def make_line(
    row: Row,
    candidate: bool,
    table: Table,
    specification: Specification,
    configuration: Configuration,
    options: Options,
) -> Line:
    """Fills a row.

    Args:
        row: which.
        candidate: whether its section competes for bold.
        table: where it stands.
        specification: of the table.
        configuration: what was run, with its runs.
        options: of the command.
    """
    content = _content(configuration.runs, table, options)
    wanted = tuple(seed for seed in table.seeds or () if seed in configuration.seeds) or configuration.seeds
    arranged = {*content.results, *content.faults, *wanted}
    runs = {s: run for s, run in configuration.runs.items() if table.source == "metrics" or s in arranged}
    listed_for_exclusion = row.model in options.exclude_failed
    excluded = {seed: run.failure for seed, run in runs.items() if run.failure and listed_for_exclusion}
    failed = {
        seed: why
        for seed, run in runs.items()
        if (why := _fault(run, content.faults.get(seed))) is not None and seed not in excluded
    }
    unfinished = {seed: run.why or "" for seed, run in runs.items() if run.state == "unfinished"}
    left_out = dict(configuration.left_out)
    counted = tuple(sorted(seed for seed in content.results if seed not in excluded))
    missing = tuple(seed for seed in wanted if seed not in {*configuration.runs, *left_out})
    if configuration.data != table.data:  # what the paper says of its own data
        row = row.model_copy(update={"published": {}, "published_excluded": 0, "fails": False})
    told = configuration.told(table.data)
    columns = [column for column in table.columns if column.key != TRACKING]
    cells = {column.key: _cell(row, column, content.results, counted) for column in columns}
    notes = [
        *(f"seed {seed} is left out: {why}" for seed, why in sorted(left_out.items())),
        *(f"seed {seed} failed: {why}" for seed, why in sorted({**failed, **({} if counted else excluded)}.items())),
        *(f"seed {seed} is not finished: {why}" for seed, why in sorted(unfinished.items())),
        *_failures_that_count(runs, counted),
        *_undefined(columns, cells, counted),
        *_unexpected(row, columns, content.results, counted),
        *(note for seed in counted if table.source == "arrangement" for note in _reasons(seed, runs[seed])),
    ]
    if listed_for_exclusion and any(run.state == "finished" for run in runs.values()):
        notes += _unchecked(runs)
    return Line(
        row=row,
        configuration=configuration,
        name=specification.label(row),
        label=", ".join([specification.label(row), *told]),
        told=told,
        latex=specification.latex(row),
        asterisk=row.fails or bool(excluded and counted) or (options.published and row.published_excluded > 0),
        tracking=_tracks(row.model, specification, runs),
        counted=counted,
        excluded={seed: str(why) for seed, why in excluded.items()},
        failed=failed,
        unfinished=unfinished,
        left_out=left_out,
        missing=missing,
        wanted=wanted,
        candidate=candidate and not row.fails,
        protocol=configuration.protocol if counted and table.source == "metrics" else None,
        cells=cells,
        notes=tuple(notes),
    )


def _tracks(model: str, specification: Specification, runs: Mapping[int, SeedRun]) -> bool | None:
    """Whether components keep identities: as the tables say, else whether there are scores of tracking."""
    if model in specification.models:
        return specification.models[model].tracking
    scored = [run.scores for run in runs.values() if "mota" in run.scores]
    return any(math.isfinite(scores["mota"]) for scores in scored) if scored else None


def _content(runs: Mapping[int, SeedRun], table: Table, options: Options) -> _Content:
    """The results of a row's seeds for one kind of table."""
    finished = {seed: run for seed, run in runs.items() if run.state == "finished"}
    if table.source == "metrics":
        return _Content({seed: {key: (value,) for key, value in run.scores.items()} for seed, run in finished.items()})
    results: dict[int, dict[str, tuple[float, ...]]] = {}
    faults: dict[int, str] = {}
    for seed, run in finished.items():
        try:
            tasks = read_arrangement(run)
        except UserError as error:
            faults[seed] = str(error)
            continue
        if tasks is not None:
            results[seed] = {key: _distances(scenarios, options) for key, scenarios in tasks.items()}
    return _Content(results, faults)


def _distances(scenarios: Sequence[Sequence[float]], options: Options) -> tuple[float, ...]:
    """One value per scenario, the mean of its objects, or one per object."""
    if options.arrangement_mean == "object":
        return tuple(distance for scenario in scenarios for distance in scenario)
    return tuple(summarise(scenario).mean for scenario in scenarios)


def _reasons(seed: int, run: SeedRun) -> list[str]:
    """Why objects did not come to their goals."""
    parts = []
    for objects, (away, total, reasons) in read_failures(run).items():
        why = ", ".join(f"{reason} {count}" for reason, count in reasons.items())
        parts.append(f"{away} of {total} with {objects} objects" + (f" ({why})" if why else ""))
    return [f"objects away from their goals, seed {seed}: {'; '.join(parts)}."] if parts else []


def _fault(run: SeedRun, fault: str | None) -> str | None:
    """Why a seed has no results though it should."""
    if run.state == "diverged":
        return f"{run.failure}; {run.why}"
    return run.why if run.state == "damaged" else fault


def _cell(
    row: Row, column: Column, results: Mapping[int, Mapping[str, tuple[float, ...]]], counted: Sequence[int]
) -> Cell:
    values = {seed: scores[column.key] for seed, scores in sorted(results.items()) if column.key in scores}
    valid = [seed for seed in counted if seed in values]
    return Cell(
        values,
        summarise(value for seed in valid for value in values[seed]) if valid else None,
        summarise(value for found in values.values() for value in found) if values else None,
        row.published.get(column.published_as or column.key),
    )


def _failures_that_count(runs: Mapping[int, SeedRun], counted: Sequence[int]) -> list[str]:
    return [
        f"seed {seed} failed by the failed-seed rule ({runs[seed].failure}) and counts all the same, "
        "since exclude_failed does not list this model."
        for seed in counted
        if runs[seed].failure
    ]


def _unchecked(runs: Mapping[int, SeedRun]) -> list[str]:
    """For models whose failed seeds are left out: seeds that the rule cannot judge."""
    unknown = [seed for seed, run in sorted(runs.items()) if run.state == "finished" and run.share is None]
    if not unknown:
        return []
    return [
        f"run.json of seed{'s' if len(unknown) > 1 else ''} {and_list(unknown)} has no foreground_share, "
        "so the failed-seed rule saw the loss alone: evaluate with split=val."
    ]


def _undefined(columns: Sequence[Column], cells: Mapping[str, Cell], counted: Sequence[int]) -> list[str]:
    """Values that no mean can hold, and results that lack a column."""
    notes = []
    for column in columns:
        values = cells[column.key].values
        lacking = [seed for seed in counted if seed not in values]
        nowhere = [seed for seed in counted if any(not math.isfinite(value) for value in values.get(seed, ()))]
        if lacking:
            notes.append(f"the results of seed {and_list(lacking)} have no {column.label} ({column.key}).")
        if nowhere:
            notes.append(
                f"{column.label} is undefined (n/a) in seed {and_list(nowhere)} and left out of the mean there."
            )
    return notes


def _unexpected(
    row: Row, columns: Sequence[Column], results: Mapping[int, Mapping[str, tuple[float, ...]]], counted: Sequence[int]
) -> list[str]:
    """Values that show that the evaluation is wrong; frames without any object have scores of their own kind."""
    notes = []
    for seed in counted:
        if any(results[seed].get("empty_frames", ())):
            continue
        wrong = [
            f"{column.label} must be {wanted:g} and is {value:.6g}"
            for column in columns
            if (wanted := row.expected.get(column.key)) is not None
            for value in results[seed].get(column.key, ())
            if not math.isclose(value, wanted, abs_tol=1e-6)
        ]
        if wrong:
            notes.append(f"{', '.join(wrong)}: do not trust this evaluation.")
    return notes
