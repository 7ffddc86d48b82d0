"""The curves of a run on one page."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import matplotlib.style
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import MaxNLocator

from apex_lab.base.errors import UserError
from apex_lab.view.canvas import picture_file
from apex_lab.view.colors import PALETTE

STEP = "step"
SPLITS = ("train", "val", "test")
_GROUPS = (*SPLITS, "diagnostics", "schedule")
_IGNORED = ("epoch",)
_COLUMNS = 4
_SPLIT_COLORS = {"train": "#2d69c3", "val": "#d55e00", "test": "#009e73"}
_NUMBERED = re.compile(r"^(?P<panel>.*?)[/_](?P<number>\d+)$")
_REST = ""
_ORDER = (
    r"(^|/)loss$",
    r"(^|/)ari_fg$",
    r"(^|/)msc_fg$",
    r"(^|/)ari$",
    r"(^|/)msc$",
    _REST,
    r"(^|/)grad",
    r"live|count",
    r"window",
    r"share|pixel|foreground",
    r"^diagnostics/",
    r"^schedule/",
    r"(^|/)lr$|learning_rate|second|memory",
)
"""Panels in reading order, by what is found in their names; `_REST` is the loss terms and all not named here."""

_TITLES = {"share": "share of pixels (0: largest object)"}
"""Titles of panels whose keys are too short."""

_SCORE = re.compile(r"^(video_)?(ari|msc|sc)(_fg)?$")
"""Quantities whose best value is 1; drawn on an axis that ends there."""


def curve_page(path: Path, curves_csv: Path) -> None:
    """Draws every column of a run's curves.csv over `step`: small multiples, one panel per quantity.

    Columns are named `group/quantity` (train, val, test, diagnostics, schedule, or nothing): the groups of one quantity
    share a panel. Columns that differ by a number at the end (`diagnostics/share_0`, `diagnostics/share_1`, ...) share
    a panel as well, one line each. Empty cells are skipped, so columns may be logged at steps of their own; columns
    without any number are left out. Quantities that stay positive and reach more than 30 times their median get a
    logarithmic axis; of others, peaks far outside the usual range are cut off, and the title gives their height.
    Long noisy curves are drawn faintly with their running median on top. The page is headed by the run folder's name.

    Args:
        path: PNG to write; equal curves make equal bytes.
        curves_csv: table with a column `step`.

    Raises:
        UserError: the table is missing, damaged or holds no number, or the picture cannot be written.
    """
    table = read_curves(curves_csv)
    panels = _panels(table)
    first, last = float(table.index[0]), float(table.index[-1])
    steps = (first - 0.03 * (last - first + 1), last + 0.03 * (last - first + 1))
    rows = math.ceil(len(panels) / _COLUMNS)
    # the user's own matplotlib settings must not change the picture
    with matplotlib.style.context("default"):
        figure = Figure(
            figsize=(3.6 * _COLUMNS, 2.5 * rows + 0.6), dpi=100, layout=ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08)
        )
        FigureCanvasAgg(figure)
        figure.suptitle("/".join(curves_csv.absolute().parts[-3:-1]), fontsize=12, fontweight="bold")
        axes = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
        for ax, (name, lines) in zip(axes, panels.items(), strict=False):
            _draw(ax, name, lines)
            ax.set_xlim(*steps)
        for ax in axes[len(panels) :]:
            ax.set_axis_off()
        with picture_file(path) as file:
            figure.savefig(file, format="png", metadata={"Software": None})


def has_rows(curves_csv: Path) -> bool:
    """Whether there is a table with more than its header; a run that lost its table can still be evaluated."""
    if not curves_csv.is_file():
        return False
    with curves_csv.open("rb") as file:
        return sum(1 for _, line in zip(range(2), file, strict=False) if line.strip()) == 2


def read_curves(curves_csv: Path) -> pd.DataFrame:
    """The table's numbers, indexed by step, without empty columns.

    Raises:
        UserError: the table is missing, damaged or holds no number.
    """
    try:
        table = pd.read_csv(curves_csv)
    except FileNotFoundError:
        raise UserError(f"{curves_csv} does not exist: train the run first, or name another run folder") from None
    except (OSError, ValueError) as error:  # pandas' parser and encoding errors are ValueErrors
        raise UserError(f"{curves_csv} cannot be read ({str(error).strip()}): restore or delete it") from error
    if STEP not in table:
        raise UserError(f"{curves_csv} has no column {STEP!r}: it is no table of curves")
    table = table.apply(pd.to_numeric, errors="coerce")
    table = table[np.isfinite(table[STEP].astype(float))]
    # quantities of one step may stand in several rows, and a run that was resumed may have made a step twice
    table = table.groupby(STEP).last().drop(columns=list(_IGNORED), errors="ignore")
    table = table.replace([np.inf, -np.inf], np.nan).dropna(axis="columns", how="all")
    if table.empty:
        raise UserError(f"{curves_csv} holds no numbers yet: let the run make some steps first")
    return table


def _panels(table: pd.DataFrame) -> dict[str, list[tuple[str, str, pd.Series]]]:
    """Panel -> its lines as (label, colour, values over step), panels in reading order."""
    panels: dict[str, list[tuple[str, str, pd.Series]]] = {}
    place: dict[str, int] = {}
    numbers = Counter(_NUMBERED.sub(r"\g<panel>", name) for name in map(str, table) if _NUMBERED.match(name))
    for name in map(str, table):
        head, _, tail = name.partition("/")
        quantity = tail if head in _GROUPS and tail else name
        split = head if head in SPLITS and tail else ""
        label, color = split, _SPLIT_COLORS.get(split, _SPLIT_COLORS["train"])
        match = _NUMBERED.match(quantity)
        if match and numbers[_NUMBERED.sub(r"\g<panel>", name)] > 1:
            quantity, label = match["panel"], f"{split} {match['number']}".strip()
            color = PALETTE[int(match["number"]) % len(PALETTE)]
        panels.setdefault(quantity, []).append((label, color, table[name].dropna()))
        place.setdefault(quantity, _place(name))
    return {name: panels[name] for name in sorted(panels, key=lambda name: place[name])}


def _place(name: str) -> int:
    """Where the panel of a column stands; panels at the same place keep their order."""
    named = (i for i, pattern in enumerate(_ORDER) if pattern and re.search(pattern, name))
    return next(named, _ORDER.index(_REST))


def _draw(ax: Axes, name: str, lines: Sequence[tuple[str, str, pd.Series]]) -> None:
    """One panel."""
    for label, color, values in lines:
        if len(values) > 100:
            ax.plot(values.index, values, color=color, linewidth=0.7, alpha=0.3)
            smooth = values.rolling(max(5, len(values) // 50), center=True, min_periods=1).median()
            ax.plot(smooth.index, smooth, color=color, linewidth=1.5, label=label)
        else:
            marker = "o" if len(values) <= 30 else None
            ax.plot(values.index, values, color=color, linewidth=1.5, marker=marker, markersize=3, label=label)
    everything = np.concatenate([values.to_numpy(float) for _, _, values in lines])
    cut = _set_range(ax, name, everything)
    ax.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    ax.set_title(_TITLES.get(name, name) + cut, fontsize=10, fontweight="bold")
    ax.tick_params(labelsize=8)
    ax.grid(visible=True, color="#e3e6ea", linewidth=0.6)
    ax.spines[["top", "right"]].set_visible(False)
    ax.set_xlabel(STEP, fontsize=8)
    if len(lines) > 1 or lines[0][0] in ("val", "test"):
        ax.legend(fontsize=7, frameon=False, ncols=1 + len(lines) // 5)


def _set_range(ax: Axes, name: str, values: np.ndarray) -> str:
    """Chooses the axis of a panel's values; what to add to the title where peaks are cut off."""
    if _SCORE.match(name):
        ax.set_ylim(min(0.0, values.min()), 1)
        return ""
    if values.min() > 0 and values.max() > 30 * np.median(values):
        ax.set_yscale("log")
        return ""
    ax.ticklabel_format(axis="y", useOffset=False)
    low, high = np.quantile(values, [0.05, 0.95])
    reach = 2 * (high - low)
    cut = ""
    if reach > 0 and values.max() > high + reach:
        ax.set_ylim(top=high + reach)
        cut += f", up to {values.max():.3g}"
    if reach > 0 and values.min() < low - reach:
        ax.set_ylim(bottom=low - reach)
        cut += f", down to {values.min():.3g}"
    return cut
