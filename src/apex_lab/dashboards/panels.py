"""Panels over the values that runs log."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import wandb_workspaces.reports.v2 as wr

from apex_lab.dashboards.studies import KEYS, Study

GROUP = "Group"
"""What W&B calls the name of a configuration, which its seeds share."""

WIDTH = 24
"""Columns of the grid on which a report's panels lie."""

LABELS = {"ari_fg": "ARI-FG", "msc_fg": "MSC-FG", "ari": "ARI", "msc": "MSC", "mota": "MOTA", "match": "Match"}

COLOURS = (("#440154", 0), ("#21918c", 50), ("#fde725", 100))
"""Low, middle and high score."""

Named = TypeVar("Named")


def curves(keys: Iterable[str], runs: int, place: str) -> list[wr.LinePlot]:
    """A panel per value: mean over the seeds of each configuration, with their standard deviation."""
    return [
        fixed(
            wr.LinePlot(
                title=label(key),
                x="Step",
                y=[key],
                title_x="weight updates",
                groupby=GROUP,
                groupby_aggfunc="mean",
                groupby_rangefunc="stddev",
                max_runs_to_show=runs,
            ),
            place,
            key,
        )
        for key in keys
    ]


def seeds(keys: Iterable[str], runs: int, place: str, grouped: bool) -> list[wr.LinePlot]:
    """A panel per value: a line per run.

    Args:
        keys: names of the values.
        runs: how many there are.
        place: where the panels stand.
        grouped: whether the runs stand in groups, so that a panel must be told to draw each of them.
    """
    words: dict[str, Any] = {"groupby": GROUP, "groupby_aggfunc": "mean", "groupby_rangefunc": "samples"}
    return [
        fixed(
            wr.LinePlot(
                title=f"{label(key)}, every seed",
                x="Step",
                y=[key],
                title_x="weight updates",
                max_runs_to_show=runs,
                **(words if grouped else {}),
            ),
            place,
            key,
        )
        for key in keys
    ]


def bars(keys: Iterable[str], configurations: int, place: str) -> list[wr.BarPlot]:
    """A panel per value of the summary: mean over the seeds of each configuration, with their standard deviation."""
    return [
        fixed(
            wr.BarPlot(
                title=label(key),
                metrics=[key],
                groupby=GROUP,
                groupby_aggfunc="mean",
                groupby_rangefunc="stddev",
                max_bars_to_show=configurations,
            ),
            place,
            key,
        )
        for key in keys
    ]


def media(keys: Iterable[str], place: str) -> list[wr.MediaBrowser]:
    """A panel per kind of picture: one of each run."""
    return [
        fixed(wr.MediaBrowser(title=label(key), media_keys=[key], num_columns=1, gallery_axis="run"), place, key)
        for key in keys
    ]


def videos(keys: Iterable[str], place: str) -> list[wr.WeavePanelSummaryTable]:
    """A table with a row per video for each key."""
    return [fixed(wr.WeavePanelSummaryTable(table_name=key), place, key) for key in keys]


def comparer(place: str) -> wr.RunComparer:
    """Settings in which the runs differ, side by side."""
    return fixed(wr.RunComparer(diff_only="split"), place, "comparer")


def sigmas(study: Study, place: str) -> list[Any]:
    """The score over both standard deviations: as coloured points on logarithmic axes, and as parallel coordinates."""
    inner, outer = (wr.Config(key) for key in KEYS)
    score = wr.SummaryMetric(study.score)
    colours = [wr.GradientPoint(color=colour, offset=offset) for colour, offset in COLOURS]
    points = wr.ScatterPlot(
        title=label(study.score), x=inner, y=outer, z=score, log_x=True, log_y=True, gradient=colours
    )
    axes = [
        wr.ParallelCoordinatesPlotColumn(metric=inner, display_name="sigma_fg", log=True),
        wr.ParallelCoordinatesPlotColumn(metric=outer, display_name="sigma_bg", log=True),
        wr.ParallelCoordinatesPlotColumn(metric=score, display_name=label(study.score)),
    ]
    lines = wr.ParallelCoordinatesPlot(title=f"sigmas and {label(study.score)}", columns=axes, gradient=colours)
    return [fixed(points, place, study.name, "points"), fixed(lines, place, study.name, "lines")]


def label(key: str) -> str:
    """What stands above a panel."""
    group, _, name = key.partition("/")
    text = LABELS.get(name, name.replace("_", " "))
    where = {"val": "validation", "train": "training"}.get(group, group)
    return text if group in ("diagnostics", "schedule") else f"{text}, {where}"


def fixed(thing: Named, *words: str) -> Named:
    """The same panel or set of runs under a name that its place gives it.

    The library draws names at random; then each update would forget what was changed by hand on the site, and the
    definition of the same runs would never be the same file.
    """
    thing._id = hashlib.sha256("/".join(words).encode()).hexdigest()[:12]  # type: ignore[attr-defined]
    return thing


def laid_out(panels: Sequence[Any], columns: int, height: int) -> list[Any]:
    """The panels row by row on the grid of a report.

    Args:
        panels: in their order.
        columns: panels in a row.
        height: of a row, in units of the grid.
    """
    width = WIDTH // columns
    for place, panel in enumerate(panels):
        row, column = divmod(place, columns)
        panel.layout = wr.Layout(x=column * width, y=row * height, w=width, h=height)
    return list(panels)
