"""Makes the paper's tables from the runs of a sweep, and the commands of what is missing.

python -m apex_lab.tables +sweep=ablations scale=cpu   the table of a sweep: a row is a configuration of its jobs
python -m apex_lab.tables                              all tables, from the runs of +sweep=paper
python -m apex_lab.tables model=op3 scale=cpu          those of its runs that are of one model, or of several
python -m apex_lab.tables scale=cpu tables=[1,3]       keys of its own: conf/tables.yaml; all other words name jobs
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hydra import compose
from pydantic import BaseModel, ConfigDict, Field

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, write_json, write_text
from apex_lab.base.validation import PathText, did_you_mean, sentence, shown, validate
from apex_lab.config import command_line as cli
from apex_lab.config import preflight
from apex_lab.config.composition import CHOICES, composing, plain
from apex_lab.config.job_list import sweeps
from apex_lab.config.reader import Reader, ending
from apex_lab.runs import provenance
from apex_lab.runs.listed import Listed, listed
from apex_lab.tables import definition as spec
from apex_lab.tables import latex, markdown
from apex_lab.tables import output_files as export
from apex_lab.tables.build import Built, build
from apex_lab.tables.configurations import configurations, plain_words
from apex_lab.tables.missing_runs import Command, missing_runs
from apex_lab.tables.rows import Options

EVERYTHING = "+sweep=paper"


class TablesConfig(BaseModel):
    """The keys of conf/tables.yaml."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    tables: tuple[int, ...] | None = Field(min_length=1)
    exclude_failed: tuple[str, ...]
    published: bool
    yardsticks: bool
    arrangement_mean: Literal["scenario", "object"]
    folder: PathText | None
    dry_run: bool


@dataclass(frozen=True)
class Tables:
    """What is asked for.

    Attributes:
        asked: the command's own keys.
        words: those that name the jobs, `+sweep=` among them.
        jobs: with their runs.
        numbers: of the tables that the sweep makes; None: of all that have rows and are made from scores.
        specification: of the tables.
        config_dir: a further folder of configuration files.
        whole: the jobs are all that the words make, not those of some models.
    """

    asked: TablesConfig
    words: tuple[str, ...]
    jobs: tuple[Listed, ...]
    numbers: tuple[int, ...] | None
    specification: spec.Specification
    config_dir: str | None = None
    whole: bool = True

    @property
    def folder(self) -> Path:
        """Where the tables go."""
        if self.asked.folder is not None:
            return Path(self.asked.folder)
        named = [word for group in ("data", "scale") for word in dict.fromkeys(j.choices[group] for j in self.jobs)]
        asked = {_key(word) for word in self.words}  # what a sweep changes by itself is known by its name
        changed = (word.lstrip("+") for job in self.jobs for word in job.changes)
        changes = list(dict.fromkeys(word for word in changed if _key(word) in asked))
        models = [] if self.whole else dict.fromkeys(job.choices["model"] for job in self.jobs)
        words = "_".join([*sweeps(self.words), *models, *named, *changes])
        outputs = str(self.jobs[0].raw["paths"]["outputs"])
        return Path(outputs) / "tables" / re.sub(r"[^\w.=,+-]+", "-", words)[:150]

    @property
    def options(self) -> Options:
        """What the parts of this package need to know of it."""
        asked = self.asked
        return Options(
            exclude_failed=asked.exclude_failed,
            published=asked.published,
            yardsticks=asked.yardsticks,
            arrangement_mean=asked.arrangement_mean,
        )


@dataclass(frozen=True)
class Made:
    """Tables, and the commands of what they lack."""

    tables: tuple[Built, ...]
    commands: tuple[Command, ...]


def main() -> None:
    """Entry point: `python -m apex_lab.tables`."""
    reader = Reader("tables", __doc__ or "")
    with ending():
        given = reader.asked()
        job = asked(given.words, given.config_dir)
        made = assemble(job)
    with ending(cli.RUN_ERROR):
        console.say(markdown.document(made.tables, job.asked.published, made.commands).rstrip("\n"))
        if not job.asked.dry_run:
            for path in store(job, made):
                console.say(str(path))


def read_tables(words: Sequence[str], config_dir: str | None = None) -> Made:
    """The tables of a command line, for other programs.

    Args:
        words: as after `python -m apex_lab.tables`.
        config_dir: a further folder of configuration files.

    Raises:
        UserError: the words are wrong.
    """
    return assemble(asked(words, config_dir))


def asked(words: Sequence[str], config_dir: str | None = None) -> Tables:
    """Reads and checks a command line, and finds the runs of its jobs.

    Raises:
        UserError: unknown key, impossible value, unknown table or model; one sentence.
    """
    own = [word for word in words if _key(word) in TablesConfig.model_fields]
    rest = [word for word in words if word not in own]
    for word in rest:
        if _key(word) == "seeds":
            raise UserError(f"{word}: the seeds of a row are those of its jobs; write seed=0,1 for two of them.")
    with composing(own):
        settings = validate(TablesConfig, plain(compose("tables", overrides=own)), "")
        assert isinstance(settings, TablesConfig)
    specification = spec.load()
    check_numbers(settings, specification)
    try:
        rest, jobs, whole = _jobs(rest, config_dir)
    except UserError:
        _refuse_misspelt(rest)
        raise
    models = dict.fromkeys([*specification.models, *(job.choices["model"] for job in jobs)])
    for model in settings.exclude_failed:
        if model not in models:
            raise UserError(f"exclude_failed: there is no model '{model}' in {', '.join(models)}.")
    found = settings.tables or preflight.sweep_tables(rest, config_dir)
    numbers = None if found is None else tuple(found)
    return Tables(settings, tuple(rest), tuple(jobs), numbers, specification, config_dir, whole)


def _jobs(words: list[str], config_dir: str | None) -> tuple[list[str], list[Listed], bool]:
    """The words with a sweep, its jobs, and whether they are all: without a sweep a model chooses among the paper's."""
    if sweeps(words):
        return words, listed(words, config_dir), True
    chosen = [word for word in words if _key(word) == "model"]
    names = {name for word in chosen for name in word.partition("=")[2].split(",")}
    jobs = listed([EVERYTHING, *(word for word in words if word not in chosen)], config_dir)
    if not chosen:
        return [EVERYTHING, *words], jobs, True
    if not names <= {job.choices["model"] for job in jobs}:  # a model that the paper does not have
        return words, listed(words, config_dir), True
    return [EVERYTHING, *words], [job for job in jobs if job.choices["model"] in names], False


def check_numbers(settings: TablesConfig, specification: spec.Specification) -> None:
    """Refuses numbers that no table has.

    Raises:
        UserError: there is one.
    """
    numbers = [table.number for table in specification.tables]
    for number in settings.tables or ():
        if number not in numbers:
            raise UserError(f"tables = {shown(settings.tables)} is wrong: there are {', '.join(map(str, numbers))}.")


def _key(word: str) -> str:
    return word.partition("=")[0].lstrip("+~")


def _refuse_misspelt(words: Sequence[str]) -> None:
    """A word that names no job may be a key of tables that is misspelt."""
    for word in words:
        guess = did_you_mean(_key(word), [*TablesConfig.model_fields])
        if guess and _key(word) not in CHOICES:
            raise UserError(sentence(f"Unknown key {word.lstrip('+~')}{guess}"))


def assemble(job: Tables) -> Made:
    """All tables with the commands of what they lack.

    Raises:
        UserError: no job has a row in a table that was asked for.
    """
    changed = list(dict.fromkeys(plain_words(each) for each in job.jobs if each.changes))
    found = dict(zip(changed, preflight.plain_fingerprints(changed, job.config_dir), strict=True)) if changed else {}
    rows = configurations(job.jobs, found)
    tables = []
    for table in job.specification.tables:
        if table.number in job.numbers if job.numbers is not None else table.source == "metrics":
            built = build(table, job.specification, rows, job.options)
            if not built and table.number in (job.asked.tables or ()):
                raise UserError(f"None of these jobs has a row in table {table.number}: {' '.join(job.words)}.")
            tables += built
    if not tables:
        raise UserError(f"None of these jobs has a row in a table: {' '.join(job.words)}.")
    all_shown = {line.configuration.name for table in tables for line in table.lines} == {row.name for row in rows}
    words = job.words if all_shown and job.whole else None
    commands = missing_runs(tables, words, job.asked.exclude_failed, job.config_dir)
    return Made(tuple(tables), tuple(commands))


def store(job: Tables, made: Made) -> list[Path]:
    """Writes tables.md, tables.tex, tables.json and table_<number>.csv; their paths.

    tables.json holds what `export.as_json` returns, `asked` (what was asked for) and `made_by` (which version).
    """
    folder, published = make_folder(job.folder), job.asked.published
    paths = [folder / name for name in ("tables.md", "tables.tex", "tables.json")]
    write_text(paths[0], markdown.document(made.tables, published, made.commands))
    write_text(paths[1], latex.document(made.tables, published, made.commands))
    commit, dirty = provenance.commit()
    about: dict[str, Any] = {
        "asked": {"words": list(job.words), **job.asked.model_dump()},
        "made_by": {"versions": provenance.versions(), "commit": commit, "dirty": dirty},
    }
    write_json(paths[2], {**about, **export.as_json(made.tables, made.commands)})
    for table in made.tables:
        paths.append(folder / f"table_{table.number}.csv")
        write_text(paths[-1], export.as_csv(table))
    return paths
