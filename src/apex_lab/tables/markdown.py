"""Tables as Markdown, readable as plain text too."""

from __future__ import annotations

from collections.abc import Sequence

from apex_lab.tables.build import Built
from apex_lab.tables.definition import Column
from apex_lab.tables.missing_runs import Command
from apex_lab.tables.rows import TRACKING, Cell, Line, rounded

MISSING, UNDEFINED = "—", "n/a"
YES, NO = "✓", "✗"
ARROWS = {"up": "↑", "down": "↓", None: ""}


def document(tables: Sequence[Built], published: bool, commands: Sequence[Command]) -> str:
    """All tables, and the commands of missing runs.

    Args:
        tables: in their order.
        published: whether the paper's values stand beside ours.
        commands: what to type for missing runs.
    """
    parts = [table_text(table, published) for table in tables]
    if commands:
        width = max(len(command.text) for command in commands)
        lines = [f"{command.text:<{width}}  # {'; '.join(command.remarks)}" for command in commands]
        parts.append("## Missing runs\n\n" + "\n".join(["```bash", *lines, "```"]))
    return "\n\n".join(parts) + "\n"


def table_text(table: Built, published: bool) -> str:
    """Heading, table, footnotes and notes."""
    head = ["", *(heading(column, table.arrows) for column in table.columns), "Seeds"]
    body: list[list[str]] = []
    for number, block in enumerate(table.blocks):
        if number:
            body.append([f"*{block.title}*" if block.title else "", *[""] * (len(head) - 1)])
        for line in block.lines:
            body.append([_escaped(label(line)), *_entries(table, line, published), line.seeds])
    widths = [max(len(row[i]) for row in (head, *body)) for i in range(len(head))]
    aligned = [_row([text.ljust(width) for text, width in zip(row, widths, strict=True)]) for row in (head, *body)]
    rule = _row(["-" * widths[0], *(f":{'-' * (width - 2)}:" for width in widths[1:])])
    below = [*table.footnotes, *table.notes]
    notes = "\n".join(f"- {_escaped(note)}" for note in below)
    parts = [f"## Table {table.number}", table.caption, "\n".join([aligned[0], rule, *aligned[1:]]), notes]
    return "\n\n".join(part for part in parts if part)


def heading(column: Column, arrows: bool) -> str:
    """What stands above a column."""
    return f"{column.label} {ARROWS[column.better]}".rstrip() if arrows else column.label


def label(line: Line) -> str:
    """What stands before a row."""
    return f"{line.label}{'*' if line.asterisk else ''}"


def number(mean: float, std: float | None, decimals: int) -> str:
    """Mean and deviation as they are printed; the mean alone where there is no deviation."""
    return rounded(mean, decimals) + ("" if std is None else f" ± {rounded(std, decimals)}")


def ours(cell: Cell, decimals: int) -> str:
    """Our value of a cell, as text."""
    if cell.summary is None:
        return MISSING
    return number(cell.summary.mean, cell.summary.std, decimals) if cell.summary.n else UNDEFINED


def _entries(table: Built, line: Line, published: bool) -> list[str]:
    found = []
    for column in table.columns:
        if column.key == TRACKING:
            found.append({True: YES, False: NO, None: MISSING}[line.tracking])
            continue
        cell = line.cells[column.key]
        text = ours(cell, table.decimals)
        text = f"**{text}**" if cell.best else text
        if published and cell.published is not None:
            text += f" ({number(*cell.published, table.decimals)})"
        found.append(text)
    return found


def _escaped(text: str) -> str:
    """Text in which Markdown sees no markup and no column."""
    for sign in "\\*|`<":
        text = text.replace(sign, f"\\{sign}")
    return text


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
