"""A report of runs as one HTML file: tables beside the paper's, curves, pictures, settings, versions, failures.

python -m apex_lab.report +sweep=ablations scale=cpu    the runs of a sweep
python -m apex_lab.report model=apex,space seed=0,1 scale=cpu megabytes=50 folder=report

python -m apex_lab.report                               all runs of +sweep=paper

Own keys: folder=, videos=, megabytes= (conf/report.yaml), and tables=, exclude_failed=, published=, yardsticks=,
arrangement_mean= (conf/tables.yaml). All other words are those of apex_lab.train and name the runs.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra import compose
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf
from pydantic import BaseModel, ConfigDict, Field

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, write_text
from apex_lab.base.validation import PathText, sentence, validate
from apex_lab.config import preflight
from apex_lab.config.composition import CHOICES, composing, conf_dir, plain
from apex_lab.config.reader import Reader, ending
from apex_lab.report.assemble import Asked, assemble
from apex_lab.report.contents import size_text
from apex_lab.report.page import render
from apex_lab.runs.listed import listed
from apex_lab.tables import definition
from apex_lab.tables.asked import EVERYTHING, Tables, TablesConfig, check_numbers

FILE = "report.html"

NAMING = ("sweep", *(group for group in CHOICES if group not in ("data", "scale")))
"""Words that say which models a report is of; without any it is of `EVERYTHING`."""

NOT_OF_TABLES = ("folder", "dry_run")
"""Keys of the tables' command that a report has not, or means itself."""


class ReportConfig(BaseModel):
    """The keys of conf/report.yaml."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    folder: PathText | None
    videos: bool
    megabytes: float = Field(ge=0, allow_inf_nan=False)


def main() -> None:
    """Entry point: `python -m apex_lab.report`."""
    reader = Reader("report", __doc__ or "")
    with ending():
        asked = reader.asked()
        path = write(asked.words, asked.config_dir)
        console.say(f"{path} ({size_text(path)})")


def write(words: Sequence[str], config_dir: str | None = None) -> Path:
    """Writes the report of a command line; its path.

    Args:
        words: the words of the command.
        config_dir: a further folder of configuration files.

    Raises:
        UserError: wrong words, or a file that cannot be written; one sentence.
    """
    own, of_tables, rest = split(words)
    if not any(_key(word) in NAMING for word in rest):
        rest = [EVERYTHING, *rest]
    settings = tables_settings(of_tables)
    jobs = listed(rest, config_dir)
    specification = definition.load()
    check_numbers(settings, specification)
    numbers = settings.tables
    if numbers is None and any(_key(word) == "sweep" for word in rest):
        found = preflight.sweep_tables(rest, config_dir)
        numbers = None if found is None else tuple(found)
    asked_tables = Tables(
        asked=settings,
        words=tuple(rest),
        jobs=tuple(jobs),
        numbers=numbers,
        specification=specification,
        config_dir=config_dir,
    )
    report = assemble(Asked(rest, words, own.videos, own.megabytes), asked_tables)
    outputs = Path(jobs[0].raw["paths"]["outputs"])
    path = (Path(own.folder) if own.folder else outputs / "reports" / slug(rest)) / FILE
    make_folder(path.parent)
    write_text(path, render(report))
    return path


def split(words: Sequence[str]) -> tuple[ReportConfig, list[str], list[str]]:
    """The report's own keys, words that are keys of the tables, and all others.

    Raises:
        UserError: a key with an impossible value.
    """
    values: dict[str, Any] = OmegaConf.to_container(OmegaConf.load(conf_dir() / "report.yaml"))  # type: ignore[assignment]
    of_tables, rest = [], []
    for word in words:
        key = word.partition("=")[0]
        if key in ReportConfig.model_fields:
            try:
                override = OverridesParser.create().parse_override(word)
                if override.is_sweep_override():
                    raise UserError(f"{word} holds several values, and there is one report: give one.")
                values[key] = override.value()
            except HydraException as error:
                text = str(error).splitlines()[0]
                raise UserError(sentence(f"'{word}' cannot be read as key=value: {text}")) from error
        elif key in TablesConfig.model_fields and key not in NOT_OF_TABLES:
            of_tables.append(word)
        else:
            rest.append(word)
    checked = validate(ReportConfig, values, "")
    assert isinstance(checked, ReportConfig)
    return checked, of_tables, rest


def tables_settings(words: Sequence[str]) -> TablesConfig:
    """The keys of conf/tables.yaml with those that the command sets.

    Raises:
        UserError: an impossible value.
    """
    with composing(words):
        settings = validate(TablesConfig, plain(compose("tables", overrides=list(words))), "")
    assert isinstance(settings, TablesConfig)
    return settings


def _key(word: str) -> str:
    return word.partition("=")[0].lstrip("+~")


def slug(words: Sequence[str]) -> str:
    """The words as the name of a folder, those about folders left out."""
    named = [word.lstrip("+").removeprefix("sweep=") for word in words if not word.lstrip("+").startswith("paths.")]
    text = re.sub(r"[^\w.,=-]+", "-", "_".join(named)).strip("-.")
    return text[:100] or "runs"
