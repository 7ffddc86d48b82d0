"""The workspace: a saved view of the runs of a sweep, section by section."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import wandb_workspaces.workspaces as ws
from wandb_workspaces import expr

from apex_lab.dashboards import panels
from apex_lab.dashboards.content import Content


def build(content: Content, entity: str, project: str) -> ws.Workspace:
    """The workspace of a sweep.

    Args:
        content: what it shows.
        entity: user or team; empty where it is not known yet.
        project: of the runs.
    """
    return ws.Workspace(
        entity=entity,
        project=project,
        name=content.title,
        sections=sections(content),
        settings=ws.WorkspaceSettings(max_runs=len(content.runs), point_visualization_method="bucketing"),
        runset_settings=ws.RunsetSettings(
            filters=only(content.runs),
            groupby=[expr.Metric("Group")],
            order=[expr.Ordering(expr.Metric("Group"), ascending=True)],
            pinned_columns=[f"summary:{key}" for key in content.topics.final],
        ),
    )


def only(runs: Sequence[str]) -> Any:
    """The filter that lets these runs through and no other, by their names."""
    return expr.And(expr.Metric("Name").isin(list(runs)))


def sections(content: Content) -> list[ws.Section]:
    """All sections that have a panel; the first ones are open."""
    topics, runs, several = content.topics, len(content.runs), len(content.rows)

    def lines(name: str, keys: Sequence[str], open: bool = True) -> tuple[str, list[Any], bool]:
        return name, panels.curves(keys, runs, name), open

    every = "Every seed"
    found: list[tuple[str, list[Any], bool]] = [
        lines("Scores on validation videos", topics.scores),
        ("Scores after training", panels.bars(topics.final, several, "Scores after training"), True),
        lines("Losses", topics.losses),
        lines("Live objects", topics.objects),
        lines("Presence", topics.presence),
        lines("Learning rate and speed", topics.rates),
        ("Film strips", panels.media(topics.strips, "Film strips"), True),
        ("Movies", panels.media(topics.movies, "Movies"), False),
        (every, panels.seeds([*topics.scores[:1], *topics.losses[:1]], runs, every, grouped=True), True),
        lines("Terms of the loss on validation videos", topics.terms, False),
        lines("Schedules", topics.schedules, False),
        lines("Other diagnostics", topics.diagnostics, False),
        ("Scores of each video", panels.videos(topics.tables, "Scores of each video"), False),
        ("Runs compared", [panels.comparer("Runs compared")], False),
    ]
    return [
        ws.Section(
            name=name,
            panels=inside,
            is_open=open,
            layout_settings=ws.SectionLayoutSettings(columns=min(3, len(inside)), rows=-(-len(inside) // 3)),
        )
        for name, inside, open in found
        if inside
    ]
