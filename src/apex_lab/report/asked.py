"""A report of runs as one HTML file: tables beside the paper's, curves, pictures, settings, versions, failures.

python -m apex_lab.report +sweep=ablations scale=cpu
python -m apex_lab.report model=apex,space seed=0,1 scale=cpu megabytes=50 folder=report

Own keys (conf/report.yaml): folder=, videos=, megabytes=. All other words are those of apex_lab.train and name the runs.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import OverrideParseException
from omegaconf import OmegaConf
from pydantic import BaseModel, ConfigDict, Field

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, write_text
from apex_lab.base.validation import sentence, validate
from apex_lab.config.composition import conf_dir
from apex_lab.config.reader import Reader, ending
from apex_lab.report.assemble import Asked, assemble
from apex_lab.report.contents import size_text
from apex_lab.report.page import render
from apex_lab.runs import provenance
from apex_lab.runs.listed import listed
from apex_lab.tables import definition
from apex_lab.tables.asked import read_tables

FILE = "report.html"


class ReportConfig(BaseModel):
    """The keys of conf/report.yaml."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    folder: str | None = Field(min_length=1)
    videos: bool
    megabytes: float = Field(ge=0, allow_inf_nan=False)


def main() -> None:
    """Entry point: `python -m apex_lab.report`."""
    reader = Reader("report", __doc__ or "")
    with ending():
        asked = reader.asked()
        console.say(str(write(asked.words, asked.config_dir)))


def write(words: Sequence[str], config_dir: str | None = None) -> Path:
    """Writes the report of a command line; its path.

    Args:
        words: the words of the command.
        config_dir: a further folder of configuration files.

    Raises:
        UserError: wrong words, no words, or a file that cannot be read or written; one sentence.
    """
    own, rest = split(words)
    if all(word.lstrip("+").startswith("paths.") for word in rest):
        raise UserError("Name the runs: +sweep=<name>, or words of apex_lab.train such as model=apex seed=0,1.")
    jobs = listed(rest, config_dir)
    tables = read_tables(rest, config_dir)
    asked = Asked(rest, words, own.videos, own.megabytes)
    report = assemble(asked, jobs, tables.tables, definition.load(), provenance.commit()[0])
    page = render(report)
    outputs = Path(jobs[0].raw["paths"]["outputs"])
    path = make_folder(Path(own.folder) if own.folder else outputs / "reports" / slug(rest)) / FILE
    write_text(path, page)
    console.say(f"{len(jobs)} runs, {size_text(path)}")
    return path


def split(words: Sequence[str]) -> tuple[ReportConfig, list[str]]:
    """The report's own keys, and all other words.

    Raises:
        UserError: a key with an impossible value.
    """
    values: dict[str, Any] = OmegaConf.to_container(OmegaConf.load(conf_dir() / "report.yaml"))  # type: ignore[assignment]
    rest = []
    for word in words:
        key = word.partition("=")[0]
        if key not in ReportConfig.model_fields:
            rest.append(word)
            continue
        try:
            values[key] = OverridesParser.create().parse_override(word).value()
        except OverrideParseException as error:
            raise UserError(sentence(f"'{word}' cannot be read as key=value: {str(error).splitlines()[0]}")) from error
    checked = validate(ReportConfig, values, "")
    assert isinstance(checked, ReportConfig)
    return checked, rest


def slug(words: Sequence[str]) -> str:
    """The words as the name of a folder, those about folders left out."""
    named = [word.lstrip("+").removeprefix("sweep=") for word in words if not word.lstrip("+").startswith("paths.")]
    text = re.sub(r"[^A-Za-z0-9.,=-]+", "-", "_".join(named)).strip("-.")
    return text[:100] or "runs"
