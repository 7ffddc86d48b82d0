"""Creates or updates a workspace and a report on Weights & Biases: curves, tables, film strips, live objects, sigmas.

python -m apex_lab.dashboards +sweep=ablations scale=cpu    the runs of a sweep
python -m apex_lab.dashboards model=apex,space seed=0,1 scale=cpu project=mine entity=team
python -m apex_lab.dashboards                               all runs of +sweep=paper

Without an account, or with dry_run=true, the definition is written to a file and nothing is sent.
Own keys: project=, entity=, folder=, dry_run= (conf/dashboards.yaml). All other words are those of apex_lab.train and
name the runs.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra import compose
from omegaconf import OmegaConf
from pydantic import BaseModel, ConfigDict, Field

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, write_json
from apex_lab.base.validation import PathText, did_you_mean, sentence, validate
from apex_lab.base.wandb_account import credentials
from apex_lab.config import command_line as cli
from apex_lab.config.composition import CHOICES, composing, conf_dir, plain
from apex_lab.config.reader import Reader, ending
from apex_lab.dashboards.content import Content, read_content, slug
from apex_lab.runs.listed import Listed, listed
from apex_lab.tables.asked import EVERYTHING

FILE = "definition.json"

NAMING = ("sweep", *(group for group in CHOICES if group not in ("data", "scale")))
"""Words that say which models are meant; without any, those of `EVERYTHING`."""


class DashboardsConfig(BaseModel):
    """The keys of conf/dashboards.yaml."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    project: str | None = Field(min_length=1)
    entity: str | None = Field(min_length=1)
    folder: PathText | None
    dry_run: bool


@dataclass(frozen=True)
class Asked:
    """What is asked for.

    Attributes:
        content: what workspace and report show.
        project: of the runs.
        entity: user or team; None for the account's default.
        folder: of definition.json and saved.json.
        kept_back: why nothing is sent; None where it is.
    """

    content: Content
    project: str
    entity: str | None
    folder: Path
    kept_back: str | None


def main() -> None:
    """Entry point: `python -m apex_lab.dashboards`."""
    reader = Reader("dashboards", __doc__ or "")
    with ending():
        given = reader.asked()
        asked = read(given.words, given.config_dir)
    with ending(cli.RUN_ERROR):
        run(asked)


def read(words: Sequence[str], config_dir: str | None = None) -> Asked:
    """Reads and checks a command line, and the runs of its jobs.

    Raises:
        UserError: wrong words, or the extra is not installed; one sentence.
    """
    own = [word for word in words if _key(word) in DashboardsConfig.model_fields]
    rest = [word for word in words if word not in own]
    with composing(own):
        settings = validate(DashboardsConfig, plain(compose("dashboards", overrides=own)), "")
    assert isinstance(settings, DashboardsConfig)
    if importlib.util.find_spec("wandb_workspaces") is None:
        raise UserError("Dashboards need wandb-workspaces: pip install 'apex_lab[dashboards]'.")
    if not any(_key(word) in NAMING for word in rest):
        rest = [EVERYTHING, *rest]
    try:
        jobs = listed(rest, config_dir)
    except UserError:
        _refuse_misspelt(rest)
        raise
    logger = _logger(jobs)
    outputs = Path(str(jobs[0].raw["paths"]["outputs"]))
    return Asked(
        content=read_content(rest, jobs, config_dir),
        project=settings.project or str(logger["project"]),
        entity=settings.entity or logger.get("entity"),
        folder=Path(settings.folder) if settings.folder else outputs / "dashboards" / slug(rest),
        kept_back=_kept_back(settings.dry_run, logger.get("mode")),
    )


def run(asked: Asked) -> None:
    """Writes the definition, sends it where there is an account, and says what was or would be done.

    Raises:
        UserError: a file cannot be written, or Weights & Biases does not take it; the definition is kept.
    """
    os.environ.setdefault("WANDB_SILENT", "true")
    from apex_lab.dashboards import saving  # imports wandb-workspaces, an extra, and takes seconds

    content, path = asked.content, make_folder(asked.folder) / FILE
    for remark in content.remarks:
        console.say(remark)
    about = {"words": list(content.words), "project": asked.project, "entity": asked.entity, "made": content.made}
    write_json(path, {**about, **saving.definition(content, asked.entity or "", asked.project)})
    console.say(str(path))
    sections, panels = saving.size(content)
    what = (
        f"the workspace '{content.title}' ({sections} sections, {panels} panels) and the report of the same name in "
        f"the project {f'{asked.entity}/' if asked.entity else ''}{asked.project}"
    )
    if asked.kept_back is not None:
        urls = saving.known_urls(asked.folder, content.words)
        verb = "update" if urls else "create"
        console.say(f"Nothing was sent, since {asked.kept_back}: this command would {verb} {what}.")
        return
    try:
        sent = saving.send(content, asked.entity, asked.project, asked.folder)
    except saving.NotSent as error:
        raise UserError(f"{sentence(str(error))[:-1]}; the definition is kept in {path}.") from error
    for one in sent:
        console.say(f"{one.kind} {'updated' if one.updated else 'created'}: {one.url}")


def _logger(jobs: Sequence[Listed]) -> dict[str, Any]:
    """The settings of the runs' W&B logger; those of conf/logger/wandb.yaml where the words choose none."""
    for job in jobs:
        if "wandb" in (job.raw.get("logger") or {}):
            return dict(job.raw["logger"]["wandb"])
    default = OmegaConf.to_container(OmegaConf.load(conf_dir() / "logger" / "wandb.yaml"))
    assert isinstance(default, dict)
    return dict(default["wandb"])


def _kept_back(dry_run: bool, mode: str | None) -> str | None:
    """Why nothing is sent, as the rest of a sentence."""
    if dry_run:
        return "dry_run=true"
    if mode == "offline":
        return "logger.wandb.mode=offline"
    if os.environ.get("WANDB_MODE", "online") not in ("online", "shared", "run"):
        return f"WANDB_MODE={os.environ['WANDB_MODE']}"
    return None if credentials() else "there are no credentials (WANDB_API_KEY, ~/.netrc)"


def _key(word: str) -> str:
    return word.partition("=")[0].lstrip("+~")


def _refuse_misspelt(words: Sequence[str]) -> None:
    """A word that names no job may be a key of this command that is misspelt."""
    for word in words:
        guess = did_you_mean(_key(word), [*DashboardsConfig.model_fields])
        if guess and _key(word) not in CHOICES:
            raise UserError(sentence(f"Unknown key {word.lstrip('+~')}{guess}"))
