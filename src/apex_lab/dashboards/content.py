"""What a workspace and a report show of the jobs of a command line. Imports no PyTorch and nothing of W&B."""

from __future__ import annotations

import hashlib
import re
import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from hydra import compose

import apex_lab
from apex_lab.base.errors import UserError
from apex_lab.base.validation import validate
from apex_lab.config import preflight
from apex_lab.config.composition import composing, plain
from apex_lab.config.job_list import sweeps
from apex_lab.dashboards.keys import Topics, topics
from apex_lab.dashboards.studies import Study, studies
from apex_lab.runs import provenance
from apex_lab.runs.listed import Listed
from apex_lab.tables import definition
from apex_lab.tables.asked import Made, Tables, TablesConfig, assemble
from apex_lab.tables.markdown import table_text


@dataclass(frozen=True)
class Row:
    """One configuration.

    Attributes:
        name: of its group on Weights & Biases.
        seeds: how many jobs it has.
        states: state of a run -> how many.
    """

    name: str
    seeds: int
    states: dict[str, int]


@dataclass(frozen=True)
class Content:
    """What is shown.

    Attributes:
        title: of workspace and report.
        words: those of `apex_lab.train` that name the jobs.
        config_dir: a further folder of configuration files.
        runs: names of their runs on Weights & Biases.
        rows: their configurations.
        topics: names of what they log.
        tables: the paper's tables as Markdown.
        missing: commands of missing runs.
        studies: of the two sigmas.
        remarks: what a reader must know before any number.
        failures: runs that ended without results, a sentence each.
        made: by which version, when.
    """

    title: str
    words: tuple[str, ...]
    config_dir: str | None
    runs: tuple[str, ...]
    rows: tuple[Row, ...]
    topics: Topics
    tables: tuple[str, ...]
    missing: tuple[str, ...]
    studies: tuple[Study, ...]
    remarks: tuple[str, ...]
    failures: tuple[str, ...]
    made: str

    @property
    def commands(self) -> list[str]:
        """What was asked for, as it can be typed again."""
        words = typed([*self.words, *(["--config-dir", self.config_dir] if self.config_dir else [])])
        logged = [] if any(word.lstrip("+").startswith("logger") for word in self.words) else ["logger=wandb"]
        train = " ".join(["python -m apex_lab.train", words, *logged, *(["-m"] if len(self.runs) > 1 else [])])
        return [train, f"python -m apex_lab.status {words}", f"python -m apex_lab.tables {words}"]


def read_content(words: Sequence[str], jobs: Sequence[Listed], config_dir: str | None = None) -> Content:
    """Reads everything that is shown from run folders.

    Args:
        words: those that name the jobs.
        jobs: with their runs; at least one.
        config_dir: a further folder of configuration files.
    """
    specification = definition.load()
    tracking = [name for name, model in specification.models.items() if model.tracking]
    try:
        made = assemble(_tables(words, jobs, specification, config_dir))
    except UserError:  # the jobs have no row in a table
        made = Made((), ())
    commit, dirty = provenance.commit()
    version = f"{apex_lab.__version__}{f', commit {commit}' if commit else ''}{' with changes' if dirty else ''}"
    return Content(
        title=title(words),
        words=tuple(words),
        config_dir=config_dir,
        runs=tuple(run_name(job) for job in jobs),
        rows=tuple(_rows(jobs)),
        topics=topics(jobs, tracking),
        tables=tuple(table_text(table, published=True) for table in made.tables),
        missing=tuple(str(command) for command in made.commands),
        studies=tuple(studies(Path(str(job.raw["paths"]["outputs"])) for job in jobs)),
        remarks=tuple(_remarks(jobs)),
        failures=tuple(
            f"{job.name}, seed {job.seed}: {job.state.reason or job.state.state}"
            for job in jobs
            if job.state.state in ("failed", "damaged")
        ),
        made=f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, apex_lab {version}",
    )


def run_name(job: Listed) -> str:
    """What `apex_lab.training.loggers.Wandb` calls the run of a job."""
    return f"{job.name}_seed_{job.seed}"


def title(words: Sequence[str]) -> str:
    """A heading of the words, without folders and loggers; W&B refuses signs such as + and = in names of workspaces."""
    shown = [word.lstrip("+~").replace("=", " ") for word in words if _names(word)]
    text = ", ".join(re.sub(r"[^\w., -]+", "-", word) for word in shown)
    return f"apex_lab: {text}"[:100].rstrip(", -")


def slug(words: Sequence[str]) -> str:
    """The words as the name of a folder; a hash tells those apart that such a name cannot."""
    joined = "_".join(word.lstrip("+").removeprefix("sweep=") for word in words if _names(word))
    text = re.sub(r"[^\w.,=-]+", "-", joined).strip("-.")[:80]
    return text if text == joined else f"{text}_{hashlib.sha256(joined.encode()).hexdigest()[:8]}"


def typed(words: Sequence[str]) -> str:
    """Words as a shell takes them."""
    return " ".join(shlex.quote(word) for word in words)


def _names(word: str) -> bool:
    return not word.lstrip("+~").startswith(("paths.", "hydra", "logger"))


def _tables(
    words: Sequence[str], jobs: Sequence[Listed], specification: definition.Specification, config_dir: str | None
) -> Tables:
    with composing(()):
        settings = validate(TablesConfig, plain(compose("tables")), "")
    assert isinstance(settings, TablesConfig)
    numbers = preflight.sweep_tables(words, config_dir) if sweeps(words) else None
    return Tables(
        settings, tuple(words), tuple(jobs), None if numbers is None else tuple(numbers), specification, config_dir
    )


def _rows(jobs: Sequence[Listed]) -> list[Row]:
    groups: dict[str, list[Listed]] = {}
    for job in jobs:
        groups.setdefault(job.name, []).append(job)
    return [
        Row(name, len(members), dict(Counter(job.state.state for job in members))) for name, members in groups.items()
    ]


def _remarks(jobs: Sequence[Listed]) -> list[str]:
    found = []
    scales = list(dict.fromkeys(scale for job in jobs if (scale := job.choices.get("scale", "")) != "paper"))
    if scales:
        found.append(f"Not paper scale but {', '.join(scales)}: these values cannot be compared with the paper's.")
    done = sum(job.state.state == "finished" for job in jobs)
    if done < len(jobs):
        found.append(f"{done} of {len(jobs)} runs were finished when this was written.")
    absent = sum(job.state.state != "waiting" and "wandb_id" not in job.state.record for job in jobs)
    if absent:
        found.append(
            f"{absent} of the runs that have started {'was' if absent == 1 else 'were'} not logged to Weights & Biases "
            "(logger=wandb): the tables count them, the panels lack them."
        )
    return found
