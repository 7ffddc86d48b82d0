"""Tables as values: rows, bold entries, caption, notes; nothing here knows a file format."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from apex_lab.tables.configurations import SCALE, Configuration, difference
from apex_lab.tables.definition import Column, Row, Section, Specification, Table
from apex_lab.tables.found import Protocol, and_list
from apex_lab.tables.rows import DDOF, TRACKING, Line, Options, make_line, rounded

COUNTS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")


@dataclass(frozen=True)
class Block:
    """Rows between two rules."""

    title: str | None
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class Built:
    """A table, ready to be written down."""

    number: str
    source: Literal["metrics", "arrangement"]
    caption: str
    decimals: int
    arrows: bool
    columns: tuple[Column, ...]
    blocks: tuple[Block, ...]
    footnotes: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def lines(self) -> list[Line]:
        """All rows."""
        return [line for block in self.blocks for line in block.lines]


def build(
    table: Table, specification: Specification, configurations: Sequence[Configuration], options: Options
) -> list[Built]:
    """Fills a table, and its variant if it has one; nothing where no configuration has a row in it.

    Args:
        table: its specification.
        specification: where it comes from.
        configurations: of the jobs.
        options: of the command.
    """
    configurations = _of_table(table, specification, configurations)
    sections = _sections(table, specification, configurations, options)
    if not any(section.rows for section in sections):
        return []
    built = [_build(table, sections, specification, configurations, options)]
    if table.variant is not None:
        suffix = table.variant.suffix
        columns = tuple(column if column.key == TRACKING else _renamed(column, suffix) for column in table.columns)
        renamed = [
            section.model_copy(update={"rows": tuple(_suffixed(row, suffix) for row in section.rows)})
            for section in sections
        ]
        again = table.model_copy(update={"caption": table.variant.caption, "columns": columns})
        variant = _build(again, renamed, specification, configurations, options)
        built.append(replace(variant, number=table.variant.number))
    return built


def _of_table(
    table: Table, specification: Specification, configurations: Sequence[Configuration]
) -> list[Configuration]:
    """Those that are not meant for a table with other data; all where none would be left."""
    others = {other.data for other in specification.tables} - {table.data}
    return [each for each in configurations if each.data not in others] or list(configurations)


def _sections(
    table: Table, specification: Specification, configurations: Sequence[Configuration], options: Options
) -> list[Section]:
    """The paper's rows that were run, rows that no table of the paper has, and yardsticks."""
    run = {configuration.row for configuration in configurations}
    others = [row for row in dict.fromkeys(c.row for c in configurations) if row not in specification.rows]
    found = [
        section.model_copy(update={"rows": tuple(row for row in section.rows if row.run in run)})
        for section in specification.sections(table, options.yardsticks)
    ]
    if others and table.source == "metrics":
        rows = tuple(Row(model=model, ablation=ablation) for model, ablation in others)
        found.insert(len(table.sections), Section(title="Not in the paper", rows=rows))
    return [section for section in found if section.rows]


def _renamed(column: Column, suffix: str) -> Column:
    other = column.published_as
    return column.model_copy(
        update={"key": column.key + suffix, "published_as": other + suffix if other is not None else None}
    )


def _suffixed(row: Row, suffix: str) -> Row:
    return row.model_copy(
        update={
            "published": {key + suffix: value for key, value in row.published.items()},
            "expected": {key + suffix: value for key, value in row.expected.items()},
        }
    )


def _build(
    table: Table,
    sections: Sequence[Section],
    specification: Specification,
    configurations: Sequence[Configuration],
    options: Options,
) -> Built:
    parts = [
        [
            make_line(row, section.candidates, table, specification, configuration, options)
            for row in section.rows
            for configuration in configurations
            if configuration.row == row.run
        ]
        for section in sections
    ]
    protocol = _main_protocol(line for part in parts for line in part)
    parts = [[_compared(line, protocol) for line in part] for part in parts]
    best = _best([line for part in parts for line in part], table)
    blocks = tuple(
        Block(section.title, tuple(_with_best(line, best, table) for line in part))
        for section, part in zip(sections, parts, strict=True)
    )
    lines = [line for block in blocks for line in block.lines]
    notes = [f"{line.label}: {note}" for line in lines for note in line.notes]
    if options.published:
        notes = [*table.published_notes, *notes]
    return Built(
        str(table.number),
        table.source,
        _caption(table, protocol, [line.configuration for line in lines], specification, options),
        table.decimals,
        table.arrows,
        table.columns,
        blocks,
        tuple(_footnotes(lines, options)),
        tuple(notes),
    )


def _main_protocol(lines: Iterable[Line]) -> Protocol | None:
    """The videos and settings that most rows were scored with."""
    counts = Counter(line.protocol for line in lines if line.protocol)
    return min(counts, key=lambda protocol: (-counts[protocol], str(protocol))) if counts else None


def _compared(line: Line, protocol: Protocol | None) -> Line:
    """A row that was scored on other videos, or otherwise, than most rows competes with none."""
    if line.protocol is None or protocol is None or line.protocol == protocol:
        return line
    told = f"scored on {difference(line.protocol, protocol)} than most rows: not comparable, not a candidate for bold."
    return replace(line, candidate=False, notes=(*line.notes, told))


def _best(lines: Iterable[Line], table: Table) -> dict[str, str]:
    """Column -> the best mean among the candidates, as it is printed."""
    candidates = [line for line in lines if line.candidate]
    found = {}
    for column in table.columns:
        if column.better is None:
            continue
        summaries = [line.cells[column.key].summary for line in candidates]
        printed = [rounded(summary.mean, table.decimals) for summary in summaries if summary is not None and summary.n]
        if printed:
            found[column.key] = (max if column.better == "up" else min)(printed, key=float)
    return found


def _with_best(line: Line, best: Mapping[str, str], table: Table) -> Line:
    """The row with its best entries marked: all that are printed like the best one of their column."""
    if not line.candidate:
        return line
    cells = {
        key: replace(cell, best=True)
        for key, cell in line.cells.items()
        if cell.summary is not None and cell.summary.n and rounded(cell.summary.mean, table.decimals) == best.get(key)
    }
    return replace(line, cells={**line.cells, **cells})


def _caption(
    table: Table,
    protocol: Protocol | None,
    configurations: Sequence[Configuration],
    specification: Specification,
    options: Options,
) -> str:
    """The caption's facts: data, scale, videos, what the deviation is over."""
    data = list(dict.fromkeys(each.data for each in configurations))
    scales = list(dict.fromkeys(each.scale for each in configurations))
    parts = [f"{table.caption}. Data {and_list(data)}, scale {and_list(scales)}"]
    others = [scale for scale in scales if scale != SCALE]
    if others:
        parts[0] += f" (not the paper's scale{'' if len(scales) == len(others) else f': {and_list(others)}'})"
    if protocol is not None:
        if protocol.videos is not None and table.source == "metrics":
            parts[0] += f", {protocol.videos} test videos"
        if protocol.data_fingerprint is not None:
            parts[0] += f", fingerprint {protocol.data_fingerprint[:8]}"
    if table.source == "metrics":
        parts.append(
            f"Mean ± standard deviation (ddof = {DDOF}) over random seeds; the last column counts the seeds in the mean"
        )
    else:
        over = "objects" if options.arrangement_mean == "object" else "scenarios (each the mean of its objects)"
        parts.append(
            f"Mean ± standard deviation (ddof = {DDOF}) over {over} of all seeds that the last column counts; "
            "an object that fell off the table counts as 1 m"
        )
    if options.published and table.data in data:
        parts.append("In parentheses: the paper's values")
        if others:
            parts[-1] += f", which are of scale {SCALE} and cannot be compared with scale {and_list(others)}"
    own = any(each.row not in specification.rows for each in configurations)
    parts.append("Bold: best of all models but the yardsticks" if own else "Bold: best of the paper's models")
    return ". ".join(parts) + "."


def _footnotes(lines: Sequence[Line], options: Options) -> list[str]:
    """What the asterisks mean."""
    found = []
    for line in lines:
        if line.row.fails or not line.asterisk:
            continue
        ours = len(line.excluded) if line.counted else 0
        theirs = line.row.published_excluded if options.published else 0
        why = "; ".join(f"seed {seed}: {reason}" for seed, reason in sorted(line.excluded.items()))
        if ours:
            text = f"* The {line.label} results are computed with {_seeds(ours)} being excluded ({why})."
            if options.published and ours != theirs:
                text += f" The paper excludes {_seeds(theirs)}."
        else:
            text = f"* The paper's {line.name} results are computed with {_seeds(theirs)} being excluded"
            text += "; ours with none." if line.counted else "."
        found.append(text)
    if any(line.row.fails for line in lines):
        found.append(
            "* In the paper these models consistently fail to meaningfully segment the images: "
            "all their seeds count, and they are no candidates for bold."
        )
    return found


def _seeds(count: int) -> str:
    number = COUNTS[count] if count < len(COUNTS) else str(count)
    return f"{number} failed random seed{'' if count == 1 else 's'}"
