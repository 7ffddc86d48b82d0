"""The report: text, tables and panels over the runs of a sweep, block by block."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import wandb_workspaces.reports.v2 as wr

from apex_lab.dashboards import panels
from apex_lab.dashboards.content import Content
from apex_lab.dashboards.studies import Study
from apex_lab.dashboards.workspace import only


def build(content: Content, entity: str, project: str) -> wr.Report:
    """The report of a sweep.

    Args:
        content: what it shows.
        entity: user or team; empty where it is not known yet.
        project: of the runs.
    """
    return wr.Report(
        entity=entity,
        project=project,
        title=content.title,
        description=f"Written by python -m apex_lab.dashboards, {content.made}.",
        blocks=blocks(content),
        width="fluid",
    )


def blocks(content: Content) -> list[Any]:
    """All blocks in their order."""
    topics, runs, several = content.topics, len(content.runs), len(content.rows)
    found: list[Any] = [wr.TableOfContents()]
    drawn: Sequence[Any]
    found += [wr.CalloutBlock(text=remark) for remark in content.remarks]
    found += [wr.H2(text="What was asked"), wr.MarkdownBlock(text=_shell(content.commands)), _overview(content)]
    if content.tables:
        found += [
            wr.H2(text="Tables"),
            wr.P(text="Mean ± standard deviation over seeds; the paper's values in brackets."),
        ]
        found += [wr.MarkdownBlock(text=table.replace("## ", "### ", 1)) for table in content.tables]
    if topics.scores or topics.losses:
        drawn = panels.curves([*topics.scores, *topics.losses], runs, "curves")
        found += [wr.H2(text="Curves: mean and standard deviation over seeds"), _grid(content, drawn, 3, 8, "curves")]
        drawn = panels.seeds([*topics.scores, *topics.losses[:1]], runs, "seeds", grouped=False)
        found += [wr.H2(text="Curves: every seed"), _grid(content, drawn, 3, 8, "seeds", grouped=False)]
    if topics.objects or topics.presence:
        drawn = panels.curves([*topics.objects, *topics.presence], runs, "objects")
        found += [wr.H2(text="Live objects and presence"), _grid(content, drawn, 3, 8, "objects")]
    drawn = panels.bars(topics.final, several, "final")
    found += [wr.H2(text="Scores after training"), _grid(content, drawn, 3, 8, "final")]
    if topics.strips:
        drawn = panels.media([*topics.strips, *topics.movies], "pictures")
        found += [wr.H2(text="Film strips and movies"), _grid(content, drawn, 1, 16, "pictures", grouped=False)]
    for study in content.studies:
        found += _sigmas(study)
    found += [wr.H2(text="Settings"), _grid(content, [panels.comparer("settings")], 1, 16, "settings", grouped=False)]
    if content.failures:
        found += [wr.H2(text="Failures"), wr.UnorderedList(items=list(content.failures))]
    if content.missing:
        found += [wr.H2(text="Missing runs"), wr.MarkdownBlock(text=_shell(content.missing))]
    return found


def _overview(content: Content) -> wr.MarkdownBlock:
    rows = [
        f"| {row.name} | {row.seeds} | {', '.join(f'{count} {state}' for state, count in row.states.items())} |"
        for row in content.rows
    ]
    head = "| configuration (group of runs) | seeds | runs |\n|---|---:|---|"
    return wr.MarkdownBlock(text="\n".join([head, *rows]))


def _grid(
    content: Content, drawn: Sequence[Any], columns: int, height: int, name: str, grouped: bool = True
) -> wr.PanelGrid:
    """Panels over the sweep's runs, by configuration or one by one."""
    return wr.PanelGrid(
        runsets=[_runs(content.runs, "Runs of the sweep", name, grouped)],
        panels=panels.laid_out(drawn, columns, height),
    )


def _runs(runs: Sequence[str], title: str, name: str, grouped: bool) -> wr.Runset:
    """A set of runs; without entity and project it is of those of the report, and nothing is looked up."""
    runset = wr.Runset(
        name=title,
        filters=only(runs),
        groupby=["Group"] if grouped else [],
        order=[wr.OrderBy("Name", ascending=True)],
    )
    return panels.fixed(runset, "runs", name)


def _sigmas(study: Study) -> list[Any]:
    text = (
        f"Study {study.name}, {len(study.runs)} runs on {study.data} at scale {study.scale}: each point is a run, its "
        f"colour the score. Optuna's contour of the same study is plots/contour.png in the study's folder."
    )
    runset = _runs(study.runs, f"Trials of {study.name}", study.name, False)
    drawn = panels.laid_out(panels.sigmas(study, "sigmas"), 2, 12)
    return [wr.H2(text="The two sigmas"), wr.P(text=text), wr.PanelGrid(runsets=[runset], panels=drawn)]


def _shell(lines: Sequence[str]) -> str:
    return "\n".join(["```bash", *lines, "```"])
