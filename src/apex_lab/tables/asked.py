"""Makes the paper's tables from the runs that are there, and prints the commands of the others.

python -m apex_lab.tables
python -m apex_lab.tables scale=cpu tables=[1,3]
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException
from pydantic import BaseModel, ConfigDict, Field

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, write_json, write_text
from apex_lab.base.validation import shown, validate
from apex_lab.config import command_line as cli
from apex_lab.config import schema as config
from apex_lab.config.composition import plain
from apex_lab.runs import folder as runs
from apex_lab.runs import provenance
from apex_lab.tables import definition as spec
from apex_lab.tables import latex, markdown
from apex_lab.tables import output_files as export
from apex_lab.tables.build import Built, build
from apex_lab.tables.choose import Choice, Version, choose
from apex_lab.tables.found import SeedRun, collect
from apex_lab.tables.missing_runs import Command, missing_runs
from apex_lab.tables.rows import Options

GROUPS = ("data", "scale", "paths")
"""Groups that choose which runs are read."""


class TablesConfig(BaseModel):
    """The keys of conf/tables.yaml that can be set."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    tables: tuple[int, ...] = Field(min_length=1)
    seeds: tuple[Annotated[int, Field(ge=0)], ...] = Field(min_length=1)
    exclude_failed: tuple[str, ...]
    groups: tuple[str, ...]
    published: bool
    yardsticks: bool
    arrangement_mean: Literal["scenario", "object"]
    folder: str | None = Field(min_length=1)
    dry_run: bool
    paths: config.PathsPart


@dataclass(frozen=True)
class Tables:
    """One checked command: what is asked for, on which data and scale, and the folders."""

    asked: TablesConfig
    data: str
    scale: str
    specification: spec.Specification
    paths: tuple[str, ...]

    @property
    def folder(self) -> Path:
        """Where the tables go."""
        if self.asked.folder is not None:
            return Path(self.asked.folder)
        return Path(self.asked.paths.outputs) / "tables" / f"{self.data}_{self.scale}"

    @property
    def options(self) -> Options:
        """What the parts of this package need to know of it."""
        asked = self.asked
        return Options(
            data=self.data,
            scale=self.scale,
            seeds=asked.seeds,
            exclude_failed=asked.exclude_failed,
            published=asked.published,
            yardsticks=asked.yardsticks,
            arrangement_mean=asked.arrangement_mean,
        )


def main() -> None:
    """Entry point: `python -m apex_lab.tables`."""
    try:
        # before anything is composed: a group of a run may need others that tables do not have
        _refuse_foreign({}, [word for word in sys.argv[1:] if not word.startswith("-")])
    except UserError as error:
        console.setup()
        console.error(str(error))
        sys.exit(cli.CONFIG_ERROR)
    cli.launch(cli.Command("tables", check_tables, make_tables, lambda job: f"tables of {job.data}, {job.scale}"))


def check_tables(raw: dict[str, Any], choices: Mapping[str, str], overrides: Sequence[str]) -> Tables:
    """Checks the command.

    Raises:
        UserError: unknown key, impossible value, unknown table or model; one sentence.
    """
    _refuse_foreign(choices, overrides)
    foreign = {*config.Config.model_fields} - {*TablesConfig.model_fields}
    asked = validate(TablesConfig, {k: v for k, v in raw.items() if k not in foreign and k != "hydra"}, "")
    assert isinstance(asked, TablesConfig)
    specification = spec.load()
    numbers = [table.number for table in specification.tables]
    for number in asked.tables:
        if number not in numbers:
            raise UserError(f"tables = {shown(asked.tables)} is wrong: there are {', '.join(map(str, numbers))}.")
    for model in asked.exclude_failed:
        if model not in specification.models:
            raise UserError(f"exclude_failed: there is no model '{model}' in {', '.join(specification.models)}.")
    if len(set(asked.seeds)) < len(asked.seeds):
        raise UserError(f"seeds = {shown(asked.seeds)} is wrong: name each seed once.")
    paths = tuple(word.lstrip("+") for word in overrides if word.lstrip("+").startswith("paths."))
    return Tables(asked, choices["data"], choices["scale"], specification, paths)


def _refuse_foreign(choices: Mapping[str, str], overrides: Sequence[str]) -> None:
    """Tables read runs as they are: words that would change a run are refused, not ignored."""
    keys = {word.split("=", 1)[0].lstrip("+~"): word for word in overrides}
    for key, word in keys.items():
        group, _, inside = key.partition(".")
        changes_run = group in config.Config.model_fields and group != "paths"
        if (changes_run and (inside or group not in GROUPS)) or (group in choices and group not in GROUPS):
            hint = "; write seeds=[...]" if group == "seed" else ""
            raise UserError(f"{word} belongs to apex_lab.train; tables take finished runs as they are{hint}.")


def make_tables(job: Tables) -> None:
    """Reads the runs, prints the tables and the missing runs' commands, and stores both.

    Raises:
        UserError: run folders that were asked for do not exist or fit no row; a folder that cannot be read or written.
    """
    found = collect(Path(job.asked.paths.outputs))
    tables, commands, problems = assemble(found, job, this_version())
    published = job.asked.published
    console.say(markdown.document(tables, published, commands, problems).rstrip("\n"))
    if not job.asked.dry_run:
        for path in store(job, tables, commands, problems):
            console.say(str(path))


def assemble(found: Sequence[SeedRun], job: Tables, version: Version) -> tuple[list[Built], list[Command], list[str]]:
    """All tables, the commands for missing runs, and a sentence for every damaged run that belongs to no row.

    Raises:
        UserError: run folders that were asked for do not exist or fit no row.
    """
    specification, options, groups = job.specification, job.options, job.asked.groups
    wanted = [table for table in specification.tables if table.number in job.asked.tables]
    sections = [section for table in wanted for section in specification.sections(table, options.yardsticks)]
    rows = dict.fromkeys(row.run for section in sections for row in section.rows)
    choices: dict[tuple[str, str | None], Choice] = {
        row: choose(found, row, job.data, job.scale, groups, version) for row in rows
    }
    _refuse_unused(groups, choices, found, job)
    tables = [built for table in wanted for built in build(table, specification, choices, options)]
    commands = missing_runs(tables, choices, options, groups, version, job.asked.paths.outputs, job.paths)
    shown_folders = {run.folder for choice in choices.values() if choice.group for run in choice.group.runs.values()}
    problems = [str(run.why) for run in found if run.state == "damaged" and run.folder not in shown_folders]
    return tables, commands, problems


def _refuse_unused(
    groups: Sequence[str], choices: Mapping[tuple[str, str | None], Choice], found: Sequence[SeedRun], job: Tables
) -> None:
    taken = {choice.group.name for choice in choices.values() if choice.group}
    there = {run.group for run in found}
    for name in groups:
        if name not in there:
            raise UserError(f"groups: there are no runs in {Path(job.asked.paths.outputs) / name}.")
        if name not in taken:
            raise UserError(f"groups: {name} fits no row of these tables, or another one was taken for its row.")


def this_version() -> Version:
    """What this version can run, as Hydra composes it; to be called while an entry point runs."""
    loader = GlobalHydra.instance().config_loader()

    def fingerprint(words: Sequence[str]) -> str | None:
        try:
            raw = plain(compose("train", overrides=list(words)))
        except (HydraException, OmegaConfBaseException, UserError):
            return None  # this version has no such configuration; the row notes it
        return runs.fingerprint(raw)

    return Version(
        models=loader.get_group_options("model", ObjectType.CONFIG),
        ablations=loader.get_group_options("ablation", ObjectType.CONFIG),
        fingerprint=fingerprint,
        arrange=importlib.util.find_spec("apex_lab.arrange") is not None,
    )


def store(job: Tables, tables: Sequence[Built], commands: Sequence[Command], problems: Sequence[str]) -> list[Path]:
    """Writes tables.md, tables.tex, tables.json and table_<number>.csv; their paths.

    tables.json holds what `export.as_json` returns, `asked` (what was asked for) and `made_by` (which version).
    """
    folder, published = make_folder(job.folder), job.asked.published
    paths = [folder / name for name in ("tables.md", "tables.tex", "tables.json")]
    write_text(paths[0], markdown.document(tables, published, commands, problems))
    write_text(paths[1], latex.document(tables, published, commands))
    commit, dirty = provenance.commit()
    about = {
        "asked": {"data": job.data, "scale": job.scale, **job.asked.model_dump()},
        "made_by": {"versions": provenance.versions(), "commit": commit, "dirty": dirty},
    }
    write_json(paths[2], {**about, **export.as_json(tables, commands, problems)})
    for table in tables:
        paths.append(folder / f"table_{table.number}.csv")
        write_text(paths[-1], export.as_csv(table))
    return paths
