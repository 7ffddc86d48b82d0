"""The paper's tables as the page shows them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from apex_lab.tables.build import Built
from apex_lab.tables.found import and_list
from apex_lab.tables.markdown import NO, YES, heading, label, number, ours
from apex_lab.tables.rows import TRACKING, Line


@dataclass(frozen=True)
class CellView:
    """One entry: our value, whether it is the best of its column, and the paper's value."""

    ours: str
    best: bool
    published: str | None


@dataclass(frozen=True)
class RowView:
    """One row."""

    label: str
    cells: list[CellView]
    seeds: str


@dataclass(frozen=True)
class BlockView:
    """Rows between two rules."""

    title: str | None
    rows: list[RowView]


@dataclass(frozen=True)
class TableView:
    """A table as text; `warning` where its values cannot stand beside the paper's."""

    number: str
    caption: str
    columns: list[str]
    blocks: list[BlockView]
    notes: list[str]
    warning: str | None


def views(tables: Sequence[Built], scales: Sequence[str]) -> list[TableView]:
    """All tables that have a value; `scales` are those of the runs."""
    other = [scale for scale in dict.fromkeys(scales) if scale != "paper"]
    warning = f"Not paper scale but {and_list(other)}: the paper's values stand beside these for orientation alone."
    return [_view(table, warning if other else None) for table in tables]


def _view(table: Built, warning: str | None) -> TableView:
    blocks = [BlockView(block.title, [_row(table, line) for line in block.lines]) for block in table.blocks]
    return TableView(
        number=table.number,
        caption=table.caption,
        columns=[heading(column, table.arrows) for column in table.columns],
        blocks=blocks,
        notes=[*table.footnotes, *table.notes],
        warning=warning if any(cell.published for b in blocks for row in b.rows for cell in row.cells) else None,
    )


def _row(table: Built, line: Line) -> RowView:
    cells = []
    for column in table.columns:
        if column.key == TRACKING:
            cells.append(CellView(YES if line.tracking else NO, False, None))
            continue
        cell = line.cells[column.key]
        published = None if cell.published is None else number(*cell.published, table.decimals)
        cells.append(CellView(ours(cell, table.decimals), cell.best, published))
    return RowView(label(line), cells, line.seeds)
