"""From the jobs of a command line to the values of a report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import apex_lab
from apex_lab.base.errors import UserError
from apex_lab.report import contents
from apex_lab.report.contents import Configuration, Seed, typed
from apex_lab.report.page import Made, Missing, Report
from apex_lab.report.pictures import MEGABYTE, MOVIE, STRIP, Budget
from apex_lab.report.tables import views
from apex_lab.runs import provenance
from apex_lab.runs.listed import Listed
from apex_lab.tables.asked import Made as MadeTables
from apex_lab.tables.asked import Tables
from apex_lab.tables.asked import assemble as make_tables
from apex_lab.tables.definition import Specification
from apex_lab.tables.missing_runs import ARRANGE, RETRY, Command

TASK = ("data", "scale")
"""Groups that a label names only where a report has several of them."""


class Asked(NamedTuple):
    """What the command asks for.

    Attributes:
        words: those of `apex_lab.train`, which name the jobs.
        command: the words of this report's command, its own keys too.
        movies: whether movies are put into the page.
        megabytes: room for pictures and movies.
    """

    words: Sequence[str]
    command: Sequence[str]
    movies: bool
    megabytes: float


def assemble(asked: Asked, tables: Tables) -> Report:
    """Everything on the page.

    Args:
        asked: by the command.
        tables: its jobs, at least one, and how tables are made from them.
    """
    jobs = tables.jobs
    rows = configurations(jobs, tables.specification)
    try:
        made_tables, no_tables = make_tables(tables), None
    except UserError as error:  # the jobs have no row in a table; all else is there to be shown
        made_tables, no_tables = MadeTables((), ()), str(error)
    budget = Budget(int(asked.megabytes * MEGABYTE))
    panels, curve_remarks = contents.panels(rows)
    pictures = contents.pictures(rows, budget, asked.movies)
    settings, setting_remarks = contents.settings(rows)
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    outputs = list(dict.fromkeys(str(job.raw["paths"]["outputs"]) for job in jobs))
    commit, dirty = provenance.commit()
    made = Made(
        date=now,
        command=typed(asked.command, "report"),
        train=typed([*asked.words, *(["-m"] if len(jobs) > 1 else [])]),
        outputs=", ".join(str(Path(folder).absolute()) for folder in outputs),
        retry=typed([*asked.words, RETRY, "-m"]),
        version=apex_lab.__version__,
        commit=f"{commit} with changes that are in no commit" if commit and dirty else commit,
    )
    return Report(
        title=title(asked.words),
        made=made,
        configurations=rows,
        tables=views(made_tables.tables, [one.choices.get("scale", "") for one in rows]),
        no_tables=no_tables,
        panels=panels,
        pictures=pictures,
        settings=settings,
        missing=[*missing(rows, jobs), *_arrangements(made_tables.commands)],
        limit=_limit(asked),
        warnings=warnings(rows),
        curve_remarks=curve_remarks,
        setting_remarks=setting_remarks,
        left_out=[f"{file}: {why}" for file, why in sorted(budget.left_out.items())],
    )


def title(words: Sequence[str]) -> str:
    """The report's heading: what was asked for, without folders."""
    shown = [word.lstrip("+") for word in words if not word.lstrip("+").startswith(("paths.", "hydra"))]
    return f"Report: {' '.join(shown)}" if shown else "Report"


def configurations(jobs: Sequence[Listed], specification: Specification) -> list[Configuration]:
    """Jobs by configuration, in the order of their first ones."""
    groups: dict[str, list[Listed]] = {}
    for job in jobs:
        groups.setdefault(job.name, []).append(job)
    labels = _labels([members[0] for members in groups.values()], specification)
    return [
        Configuration(
            name=name,
            label=label,
            model=_model(members[0], specification),
            choices=members[0].choices,
            settings=members[0].raw,
            seeds=tuple(Seed(job.seed, job.state, typed(job.words)) for job in members),
        )
        for (name, members), label in zip(groups.items(), labels, strict=True)
    ]


def _labels(jobs: Sequence[Listed], specification: Specification) -> list[str]:
    """A label for each configuration: model and ablation, then what tells it from the others of the same name."""
    names = {(row.model, row.ablation): row.label for t in specification.tables for s in t.sections for row in s.rows}
    several = [group for group in TASK if len({job.choices.get(group) for job in jobs}) > 1]

    def label(job: Listed) -> str:
        model, ablation = job.choices.get("model", ""), job.choices.get("ablation")
        parts = [_model(job, specification)]
        if ablation:
            parts.append(names.get((model, ablation)) or ablation)
        parts += [f"{group}={job.choices[group]}" for group in ("experiment", "tuned") if group in job.choices]
        parts += [job.choices[group] for group in several if group in job.choices]
        return ", ".join(parts)

    found = [label(job) for job in jobs]
    counts = Counter(found)
    found = [
        ", ".join([text, *job.changes]) if counts[text] > 1 else text for text, job in zip(found, jobs, strict=True)
    ]
    counts = Counter(found)
    return [f"{text} ({job.name[-8:]})" if counts[text] > 1 else text for text, job in zip(found, jobs, strict=True)]


def _model(job: Listed, specification: Specification) -> str:
    """What the tables call a job's model; its word where they do not know it."""
    word = job.choices.get("model", "")
    return specification.models[word].label if word in specification.models else word


def warnings(rows: Sequence[Configuration]) -> list[str]:
    """What a reader must know before any number."""
    found = []
    scales = list(dict.fromkeys(scale for one in rows if (scale := one.choices.get("scale", "")) != "paper"))
    if scales:
        found.append(f"Not paper scale: {', '.join(scales)}. These values cannot be compared with the paper's.")
    counts = contents.counts(rows)
    if counts[contents.DONE] < counts.total():
        found.append(
            f"{counts.total() - counts[contents.DONE]} of {counts.total()} runs are not finished: all numbers are of "
            "the others."
        )
    prints: dict[tuple[str, str], set[str]] = {}
    for one in rows:
        for seed in one.seeds:
            if value := seed.state.record.get("data_fingerprint"):
                key = one.choices.get("data", ""), one.choices.get("scale", "")
                prints.setdefault(key, set()).add(str(value))
    for (data, scale), values in prints.items():
        if len(values) > 1:
            found.append(f"Runs on {data}, scale {scale}, saw {len(values)} versions of the data.")
    return found


def missing(rows: Sequence[Configuration], jobs: Sequence[Listed]) -> list[Missing]:
    """The commands of what was never started or waits to be resumed, one per configuration."""
    words: Mapping[str, tuple[str, ...]] = {job.name: job.words for job in reversed(jobs)}
    found = []
    for row in rows:
        for state, what in (("waiting", "never started"), ("paused", "paused")):
            seeds = row.of_state(state)
            if seeds:
                text = f"seed{'s' if len(seeds) > 1 else ''} {contents.ranges(seeds)} {what}"
                found.append(Missing(row.label, text, typed(reseeded(words[row.name], seeds))))
    return found


def _arrangements(commands: Sequence[Command]) -> list[Missing]:
    """Those commands of the tables that train nothing."""
    return [
        Missing(one.remarks[0], "; ".join(["arrangement task", *one.remarks[1:]]), one.text)
        for one in commands
        if one.text.startswith(ARRANGE)
    ]


def reseeded(words: Sequence[str], seeds: Sequence[int]) -> list[str]:
    """The words of a job for other seeds."""
    seed = f"seed={','.join(map(str, sorted(seeds)))}"
    found = [seed if word.startswith("seed=") else word for word in words]
    return [*found, *([] if seed in found else [seed]), *(["-m"] if len(seeds) > 1 else [])]


def _limit(asked: Asked) -> str:
    movies = "" if asked.movies else " No movies were asked for (videos=false)."
    return (
        f"Film strips and movies are of one seed of each configuration ({STRIP} and {MOVIE} in its folder) and may "
        f"take {asked.megabytes:g} MB (megabytes={asked.megabytes:g}); film strips come first.{movies} Panels of "
        "single components, scores of single videos, logs and checkpoints are in the run folders."
    )
