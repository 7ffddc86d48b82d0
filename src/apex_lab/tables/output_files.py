"""Tables for other programs: JSON with everything, CSV with a line per row and column; unrounded values."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from typing import Any

from apex_lab.tables.build import Built
from apex_lab.tables.definition import Column
from apex_lab.tables.markdown import label, ours
from apex_lab.tables.missing_runs import Command
from apex_lab.tables.rows import DDOF, TRACKING, Cell, Line, Summary


def as_json(tables: Sequence[Built], commands: Sequence[Command]) -> dict[str, Any]:
    """Everything the tables hold.

    Returns:
        `ddof`; `tables`, each with `number`, `caption`, `columns`, `rows`, `footnotes` and `notes`; `commands` with
        `text` and `remarks`. A row has `label`, `model`, `ablation`, `data`, `scale`, `changes` (further
        words that make its configuration), `group` (folder of its runs), `seeds` (lists and reasons under the names of
        `rows.Line`) and `cells`. A cell has `mean`, `std` and `n` over the seeds that count, the same under
        `over_all_seeds`, `per_seed` (all seeds with results; for the arrangement task a mean over scenarios), `values`
        (arrangement alone: all scenarios), `published` and `best`. Undefined values are null.
    """
    return {
        "ddof": DDOF,
        "tables": [_table(table) for table in tables],
        "commands": [{"text": command.text, "remarks": list(command.remarks)} for command in commands],
    }


def _table(table: Built) -> dict[str, Any]:
    return {
        "number": table.number,
        "caption": table.caption,
        "columns": [column.model_dump() for column in table.columns],
        "rows": [_row(table, line) for line in table.lines],
        "footnotes": list(table.footnotes),
        "notes": list(table.notes),
    }


def _row(table: Built, line: Line) -> dict[str, Any]:
    protocol = line.protocol
    return {
        "label": label(line),
        "model": line.row.model,
        "ablation": line.row.ablation,
        "tracking": line.tracking,
        "data": line.configuration.data,
        "scale": line.configuration.scale,
        "changes": list(line.configuration.changes),
        "group": line.configuration.folder,
        "data_fingerprint": protocol.data_fingerprint if protocol else None,
        "videos": protocol.videos if protocol else None,
        "frames": protocol.frames if protocol else None,
        "candidate": line.candidate,
        "seeds": {
            "wanted": list(line.wanted),
            "counted": list(line.counted),
            "excluded": line.excluded,
            "failed": line.failed,
            "unfinished": line.unfinished,
            "left_out": line.left_out,
            "missing": list(line.missing),
        },
        "cells": {
            column.key: _cell(table, column, line.cells[column.key])
            for column in table.columns
            if column.key != TRACKING
        },
        "notes": list(line.notes),
    }


def _cell(table: Built, column: Column, cell: Cell) -> dict[str, Any]:
    found: dict[str, Any] = {
        **_summary(cell.summary),
        "ddof": DDOF,
        "per_seed": _per_seed(cell),
        "over_all_seeds": _summary(cell.over_all),
        "best": cell.best,
        "published": _published(column, cell),
    }
    if table.source == "arrangement":
        found["values"] = {str(seed): list(values) for seed, values in cell.values.items()}
    return found


def _per_seed(cell: Cell) -> dict[str, float]:
    """A value per seed; NaN where it is undefined."""
    return {str(seed): _mean(values) for seed, values in cell.values.items()}


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return math.fsum(known) / len(known) if known else math.nan


def _summary(summary: Summary | None) -> dict[str, Any]:
    if summary is None:
        return {"n": 0, "mean": None, "std": None}
    return {"n": summary.n, "mean": summary.mean, "std": summary.std}


def _published(column: Column, cell: Cell) -> dict[str, Any] | None:
    if cell.published is None:
        return None
    mean, std = cell.published
    return {"mean": mean, "std": std, "printed_as": column.published_as or column.key}


def as_csv(table: Built) -> str:
    """A table as CSV, a line per row and column; empty fields where there is no value.

    Columns: `row`, `model`, `ablation`, `data`, `scale`, `changes`, `group`, `column`, `key`, `better`, `mean`, `std`,
    `n`, `ddof`, `text` (as printed), `best`, `published_mean`, `published_std`, `published_as`, `counted_seeds`,
    `excluded_seeds`, `failed_seeds` (numbers with spaces between), and `seed_<n>` for every seed with results.
    """
    rows = [(line, column, line.cells[column.key]) for line in table.lines for column in table.columns if column.better]
    seeds = sorted({seed for _, _, cell in rows for seed in cell.values})
    records = []
    for line, column, cell in rows:
        published = _published(column, cell) or {"mean": None, "std": None, "printed_as": None}
        summary = _summary(cell.summary)
        records.append(
            {
                "row": label(line),
                "model": line.row.model,
                "ablation": line.row.ablation,
                "data": line.configuration.data,
                "scale": line.configuration.scale,
                "changes": " ".join(line.configuration.changes),
                "group": line.configuration.folder,
                "column": column.label,
                "key": column.key,
                "better": column.better,
                "mean": _number(summary["mean"]),
                "std": _number(summary["std"]),
                "n": summary["n"],
                "ddof": DDOF,
                "text": ours(cell, table.decimals),
                "best": cell.best,
                "published_mean": published["mean"],
                "published_std": published["std"],
                "published_as": published["printed_as"],
                "counted_seeds": _spaced(line.counted),
                "excluded_seeds": _spaced(sorted(line.excluded)),
                "failed_seeds": _spaced(sorted(line.failed)),
                **{f"seed_{seed}": _number(_mean(cell.values.get(seed, ()))) for seed in seeds},
            }
        )
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(records[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return text.getvalue()


def _number(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _spaced(seeds: Sequence[int]) -> str:
    return " ".join(str(seed) for seed in seeds)
