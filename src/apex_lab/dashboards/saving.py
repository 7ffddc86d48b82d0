"""Definitions as JSON, and sent to Weights & Biases: what was sent before is updated, not made again."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import wandb
import wandb_workspaces.reports.v2 as wr
import wandb_workspaces.workspaces as ws

from apex_lab.base.errors import UserError
from apex_lab.base.files import read_json, write_json
from apex_lab.base.validation import one_line
from apex_lab.dashboards import report, workspace
from apex_lab.dashboards.content import Content

SAVED = "saved.json"

Kind = Literal["report", "workspace"]
View = TypeVar("View", ws.Workspace, wr.Report)


class NotSent(UserError):
    """Weights & Biases did not take what was sent."""


@dataclass(frozen=True)
class Sent:
    """What was sent: which of the two, where it is now, and whether it had been there before."""

    kind: Kind
    url: str
    updated: bool


def definition(content: Content, entity: str, project: str) -> dict[str, Any]:
    """Workspace and report as the library sends them: its classes `View` and `ReportViewspec` as plain values."""
    views: dict[str, Any] = {
        "workspace": workspace.build(content, entity, project),
        "report": report.build(content, entity, project),
    }
    # the library's `save` sends what its models dump in the same way
    dumps = {name: view._to_model().model_dump_json(by_alias=True, exclude_none=True) for name, view in views.items()}
    return {name: json.loads(text) for name, text in dumps.items()}


def size(content: Content) -> tuple[int, int]:
    """Sections and panels of the workspace."""
    sections = workspace.sections(content)
    return len(sections), sum(len(section.panels) for section in sections)


def send(content: Content, entity: str | None, project: str, folder: Path) -> list[Sent]:
    """Creates or updates report and workspace, and notes in `folder` where they are.

    The report comes first, since saving it makes a project that is not there yet.

    Args:
        content: what both show.
        entity: user or team; None for the account's default.
        project: of the runs.
        folder: of saved.json.

    Raises:
        NotSent: no network, a refused key, or a project without access; what was sent before that is noted.
    """
    os.environ.setdefault("WANDB_SILENT", "true")
    entity = entity or _asked(lambda: wandb.Api().default_entity)
    if not entity:
        raise NotSent("Weights & Biases knows no default entity of this account: give entity=NAME.")
    place = f"{entity}/{project}: {' '.join(content.words)}"
    saved = _read(folder / SAVED)
    known = saved.setdefault(place, {})
    sent = []
    kinds: tuple[Kind, ...] = ("report", "workspace")
    for kind in kinds:
        view, updated = _view(kind, content, entity, project, known.get(kind))
        known[kind] = _asked(lambda view=view: str(view.save().url))  # type: ignore[misc]
        write_json(folder / SAVED, saved)
        sent.append(Sent(kind, known[kind], updated))
    return sent


def known_urls(folder: Path, words: tuple[str, ...]) -> list[str]:
    """Where earlier workspaces and reports of the same words are."""
    saved = _read(folder / SAVED)
    same = [urls for place, urls in saved.items() if place.partition(": ")[2] == " ".join(words)]
    return [url for urls in same for url in urls.values()]


def _view(kind: Kind, content: Content, entity: str, project: str, url: str | None) -> tuple[Any, bool]:
    """The workspace or report to save, and whether it stands in place of an earlier one."""
    build, load, parts = {
        "report": (report.build, wr.Report.from_url, ("title", "description", "width", "blocks")),
        "workspace": (workspace.build, ws.Workspace.from_url, ("name", "settings", "runset_settings", "sections")),
    }[kind]
    new, old = build(content, entity, project), _found(load, url)
    if old is None:
        return new, False
    for part in parts:
        setattr(old, part, getattr(new, part))
    return old, True


def _found(load: Callable[[str], View], url: str | None) -> View | None:
    """What is at an address; None where nothing is any more, since somebody has deleted it."""
    if url is None:
        return None
    try:
        return _asked(lambda: load(url))
    except NotSent as error:
        cause = error.__cause__
        # what the library raises where the answer holds no view: of a workspace, and of a report
        if type(cause) is TypeError or (type(cause) is ValueError and "not found" in str(cause)):
            return None
        raise


def _asked(call: Callable[[], Any]) -> Any:
    """What a call of the library returns.

    Raises:
        NotSent: whatever it raises; it has no common exception for a network that is away, a refused key and an answer
            that it cannot read.
    """
    try:
        return call()
    except Exception as error:
        raise NotSent(f"Weights & Biases did not take it ({one_line(error)})") from error


def _read(path: Path) -> dict[str, dict[str, str]]:
    """Addresses by entity, project and words; none where there is no such file.

    Raises:
        UserError: it is damaged; updating would make a second workspace.
    """
    if not path.is_file():
        return {}
    content = read_json(path)
    if not all(
        isinstance(urls, dict) and all(isinstance(url, str) for url in urls.values()) for urls in content.values()
    ):
        raise UserError(f"{path} does not hold addresses: delete it, and a new workspace and report are made.")
    return content
