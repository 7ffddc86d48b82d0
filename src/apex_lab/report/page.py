"""A report as one HTML file that needs nothing else: style, script, drawings, pictures and movies stand inside."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from apex_lab.report import charts, contents
from apex_lab.report.contents import Configuration, Panel, Pictures, Settings
from apex_lab.report.facts import facts
from apex_lab.report.tables import TableView

CONTENTS = (
    ("asked", "What was asked"),
    ("overview", "Overview"),
    ("tables", "Tables"),
    ("curves", "Curves"),
    ("pictures", "Pictures"),
    ("settings", "Settings"),
    ("versions", "Versions"),
    ("failures", "Failures"),
    ("missing", "Missing"),
    ("left-out", "Left out"),
)
"""Sections in their order: anchor, short heading."""


@dataclass(frozen=True)
class Made:
    """How a report was made.

    Attributes:
        date: ISO 8601, UTC.
        command: that makes it again.
        train: that makes or resumes its runs.
        retry: the same, failed ones too.
        outputs: where the runs lie.
        version, commit: of the code that made the report; the commit is None outside a repository.
    """

    date: str
    command: str
    train: str
    retry: str
    outputs: str
    version: str
    commit: str | None


@dataclass(frozen=True)
class Missing:
    """Work that is still to be done: whose, what, by which command."""

    label: str
    what: str
    command: str


@dataclass(frozen=True)
class Report:
    """Everything on the page."""

    title: str
    made: Made
    configurations: Sequence[Configuration]
    tables: Sequence[TableView]
    panels: Sequence[Panel]
    pictures: Sequence[Pictures]
    settings: Sequence[Settings]
    missing: Sequence[Missing]
    limit: str
    no_tables: str | None = None
    warnings: Sequence[str] = ()
    curve_remarks: Sequence[str] = ()
    setting_remarks: Sequence[str] = ()
    left_out: Sequence[str] = field(default_factory=list)


def render(report: Report) -> str:
    """The report as HTML 5. All text is escaped; a browser runs no script but the page's own and loads nothing."""
    environment = _environment()
    style, script = (_source(environment, name) for name in ("style.css", "script.js"))
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    )
    return environment.get_template("page.html").render(
        **{name: getattr(report, name) for name in report.__dataclass_fields__ if name != "configurations"},
        contents=CONTENTS,
        policy=policy,
        style=Markup(style),
        script=Markup(script),
        geometry={
            "width": charts.WIDTH,
            "height": charts.HEIGHT,
            **{"left": charts.LEFT, "right": charts.RIGHT, "top": charts.TOP, "bottom": charts.BOTTOM},
        },
        overview=_overview(report.configurations),
        facts=facts(report.configurations),
        failures=_failures(report.configurations),
    )


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("apex_lab.report", "page"),
        autoescape=True,  # names, reasons and words of runs are other people's text
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _source(environment: Environment, name: str) -> str:
    """A file of the page as it is."""
    assert environment.loader is not None
    return environment.loader.get_source(environment, name)[0]


def _overview(configurations: Sequence[Configuration]) -> dict[str, Any]:
    """Numbers and rows of the overview."""
    found = contents.counts(configurations)
    order = (contents.DONE, *contents.OPEN, *contents.BROKEN)
    return {
        "jobs": found.total(),
        "configurations": len(configurations),
        "states": [(state, found[state]) for state in order if found[state] or state in ("finished", "failed")],
        "hours": sum(one.hours for one in configurations),
        "rows": [
            {
                "label": one.label,
                "name": one.name,
                "finished": len(one.finished),
                "jobs": len(one.seeds),
                "hours": one.hours,
                "states": [(state, contents.ranges(seeds)) for state in order if (seeds := one.of_state(state))],
            }
            for one in configurations
        ],
    }


def _failures(configurations: Sequence[Configuration]) -> list[dict[str, Any]]:
    """Runs that ended without results."""
    return [
        {
            "label": one.label,
            "seed": seed.number,
            "state": seed.state.state,
            "reason": seed.state.reason,
            "steps": seed.state.steps,
            "command": seed.command,
        }
        for one in configurations
        for seed in one.seeds
        if seed.state.state in contents.BROKEN
    ]
