"""What wandb-workspaces talks to, in memory: it keeps views as W&B's server does."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pytest
import wandb
import wandb_workspaces.reports.v2.interface as of_reports
import wandb_workspaces.workspaces.internal as of_workspaces


class FakeServer:
    """Views by id; `down` makes every request fail, `full` every request that stores a workspace."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.views: dict[str, dict[str, Any]] = {}
        self.projects: list[str] = []
        self.down = self.full = False
        monkeypatch.setattr(wandb, "Api", self.api)
        # the real Api obeys WANDB_SILENT
        monkeypatch.setattr(wandb, "termlog", lambda text: None)
        monkeypatch.setattr(of_reports, "execute_graphql", self.answer)
        monkeypatch.setattr(of_workspaces, "execute_graphql", self.answer)

    def api(self) -> Any:
        self.refuse(self.down)
        return SimpleNamespace(
            default_entity="team",
            client=SimpleNamespace(app_url="https://wandb.example/"),
            projects=lambda entity: [SimpleNamespace(name=name) for name in self.projects],
            create_project=lambda name, entity: self.projects.append(name),
        )

    def refuse(self, when: bool) -> None:
        if when:
            raise wandb.errors.CommError("no route\nto host")

    def answer(self, api: Any, query: str, variables: dict[str, Any]) -> dict[str, Any]:
        self.refuse(self.down)
        if "upsertView" in query:
            self.refuse(self.full and variables["type"] == "project-view")
            return {"upsertView": {"view": self.stored(variables)}}
        if "SpecificReport" in query:
            return {"view": self.views.get(variables["reportId"])}
        assert "allViews" in query
        found = [{"node": view} for view in self.views.values() if view["name"] == variables["viewName"]]
        return {"project": {"allViews": {"edges": found}}}

    def stored(self, given: dict[str, Any]) -> dict[str, Any]:
        name = given.get("id") or ("VmlldzoxMTEx" if given["type"] == "runs" else "VmlldzoyMjIy")
        name = name if given.get("id") or name not in self.views else f"{name}{len(self.views):04d}"
        project = {"name": given["projectName"], "entityName": given["entityName"], "id": "UHJvamVjdA=="}
        kept = {"id": name, "name": given["name"], "displayName": given["displayName"], "spec": given["spec"]}
        assert not given.get("id") or given["id"] in self.views
        self.views[name] = {**kept, "description": given["description"], "project": project, "type": given["type"]}
        return dict(self.views[name])

    def spec(self, kind: str) -> Any:
        """What is stored of the only view of a kind."""
        [view] = [view for view in self.views.values() if view["type"] == kind]
        return json.loads(view["spec"])
