"""`python -m apex_lab.dashboards`: the definition by the library's own schema, names of values by what runs log."""

from __future__ import annotations

import csv
import functools
import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("wandb_workspaces", reason="needs the extra 'dashboards'")

from wandb_workspaces.reports.v2.internal import ReportViewspec
from wandb_workspaces.workspaces import Workspace
from wandb_workspaces.workspaces.internal import View

from apex_lab.base.files import write_json
from apex_lab.dashboards import asked
from apex_lab.dashboards.content import slug, title
from apex_lab.dashboards.keys import DIAGNOSTICS, TRACKING_SCORES
from apex_lab.runs.listed import Listed, listed
from tests.conftest import TINY, Ended
from tests.dashboards.fake_server import FakeServer
from tests.training import wandb_file


@functools.cache
def composed(words: tuple[str, ...], folder: str) -> tuple[Listed, ...]:
    """Jobs whose folders are relative, so each test has its own."""
    return tuple(listed(words, folder))


@pytest.fixture
def dashboards(command: Callable[..., Ended], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Ended]:
    """Runs the command on the tiny model, without credentials; the same words are composed once in all tests."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    monkeypatch.setattr(asked, "listed", lambda words, folder: [job.again() for job in composed(tuple(words), folder)])
    return lambda *words: command("dashboards", *TINY[:-1], *words)


@pytest.fixture
def server(dashboards: Callable[..., Ended], monkeypatch: pytest.MonkeyPatch) -> FakeServer:
    """A server and credentials for it."""
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    return FakeServer(monkeypatch)


def definition(folder: Path) -> dict[str, Any]:
    [file] = folder.glob("**/definition.json")
    return dict(json.loads(file.read_text()))


def every_panel(found: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for section in found["workspace"]["spec"]["section"]["panelBankConfig"]["sections"]:
        yield from section["panels"]
    for block in found["report"]["spec"]["blocks"]:
        if block["type"] == "panel-grid":
            yield from block["metadata"]["panelBankSectionConfig"]["panels"]


def keys(found: dict[str, Any]) -> set[str]:
    """Every name of a logged value in a panel."""
    names: set[str] = set()
    for panel in every_panel(found):
        config = panel["config"]
        names.update(config.get("metrics") or config.get("mediaKeys") or ())
    return names


def filters(found: dict[str, Any]) -> list[list[str]]:
    """The names of runs that each set of runs lets through."""
    sets = list(found["workspace"]["spec"]["section"]["runSets"])
    for block in found["report"]["spec"]["blocks"]:
        if block["type"] == "panel-grid":
            sets += block["metadata"]["runSets"]
    names = []
    for one in sets:
        [only] = one["filters"]["filters"]
        assert (only["key"], only["op"]) == ({"section": "run", "name": "displayName"}, "IN")
        names.append(only["value"])
    return names


def test_without_an_account_the_definition_is_written_and_passes_the_library_s_schema(
    dashboards: Callable[..., Ended], tmp_path: Path
) -> None:
    ended = dashboards("seed=0,1")
    assert (ended.code, ended.err) == (0, "")
    assert "Not paper scale but smoke" in ended.out
    assert "Nothing was sent, since there are no credentials" in ended.out
    assert "this command would create the workspace 'apex_lab: model tiny, data squares" in ended.out
    found = definition(tmp_path / "outputs" / "dashboards")
    view = View.model_validate(found["workspace"])
    assert json.loads(view.model_dump_json(by_alias=True, exclude_none=True)) == found["workspace"]
    read = Workspace._from_model(view)
    assert json.loads(read._to_model().model_dump_json(by_alias=True, exclude_none=True)) == found["workspace"]
    assert [section.name for section in read.sections][:2] == ["Scores on validation videos", "Scores after training"]
    assert not [panel for section in read.sections for panel in section.panels if "Unknown" in type(panel).__name__]
    spec = ReportViewspec.model_validate(found["report"])
    assert not [block for block in spec.spec.blocks if "Unknown" in type(block).__name__]
    text = spec.model_dump_json(by_alias=True, exclude_none=True)
    # its reader gives a heading an empty list of comments
    assert json.loads(text.replace(',"inlineComments":[]', "")) == found["report"]
    names = [f"{job.name}_seed_{job.seed}" for job in composed((*TINY[2:-1], "seed=0,1"), TINY[1])]
    assert filters(found) == [names] * len(filters(found))
    assert {"val/ari_fg", "train/loss", "schedule/lr", "test/ari_fg", "test/film_strip", "test/movie"} <= keys(found)
    ids = [panel["__id__"] for panel in every_panel(found)]
    assert len(set(ids)) == len(ids)
    assert dashboards("seed=0,1").code == 0
    again = definition(tmp_path / "outputs" / "dashboards")
    assert again["workspace"] == found["workspace"]


@pytest.mark.slow
def test_panels_name_what_a_run_logs(
    dashboards: Callable[..., Ended], command: Callable[..., Ended], tmp_path: Path
) -> None:
    words = ("trainer.max_steps=4", "evaluation.pictures=1")
    ended = command("train", *TINY[:-1], *words, "logger=wandb")
    assert ended.code == 0, ended.err
    [file] = tmp_path.glob("outputs/*/seed_0/wandb/offline-run-*/run-*.wandb")
    records = wandb_file.records(file)
    logged = {key for row in wandb_file.history(records) for key in row} | set(wandb_file.summary(records))
    assert dashboards(*words).code == 0
    found = definition(tmp_path / "outputs" / "dashboards")
    assert keys(found) - logged == set()
    assert {"val/ari_fg", "val/mota", "train/loss", "schedule/lr", "test/film_strip", "test/movie"} <= keys(found)
    curves = {name for row in wandb_file.history(records) for name in row if row.get("train/loss") or "val/loss" in row}
    rest = curves - keys(found) - {"step", "_step", "_runtime", "_timestamp"}
    assert {name for name in rest if not name.startswith(("train/", "_", "test/"))} == set()
    assert filters(found) == [[wandb_file.run(records).display_name]] * len(filters(found))
    tables = [panel for panel in every_panel(found) if panel["viewType"] == "Weave"]
    assert len(tables) == 1
    assert "test/per_video" in json.dumps(tables)
    assert "test/per_video" in logged


@pytest.mark.slow
@pytest.mark.parametrize("model", DIAGNOSTICS)
def test_diagnostics_are_those_of_the_models(model: str, command: Callable[..., Ended], tmp_path: Path) -> None:
    words = (f"model={model}", "data=sprites", "scale=smoke", "trainer.max_steps=4", "evaluation.pictures=0")
    assert command("train", *words).code == 0
    [file] = tmp_path.glob("outputs/*/seed_0/curves.csv")
    with open(file, newline="") as opened:
        columns = next(csv.reader(opened))
    found = [name.partition("/")[2] for name in columns if name.startswith("diagnostics/")]
    assert {name for name in found if not name.startswith("share_")} == set(DIAGNOSTICS[model])
    assert set(columns).issuperset(f"val/{name}" for name in TRACKING_SCORES) == (
        model not in ("space", "slot_attention")
    )


def test_a_second_time_updates_what_the_first_made(dashboards: Callable[..., Ended], server: FakeServer) -> None:
    first = dashboards()
    assert (first.code, first.err) == (0, "")
    assert "report created: https://wandb.example/team/apex_lab/reports/" in first.out
    assert "workspace created: https://wandb.example/team/apex_lab?nw=" in first.out
    assert server.projects == ["apex_lab"]
    before = {name: view["name"] for name, view in server.views.items() if view["type"] == "project-view"}
    assert len(server.views) == 2
    sections = server.spec("project-view")["section"]["panelBankConfig"]["sections"]
    second = dashboards()
    assert (second.code, second.err) == (0, "")
    assert "report updated: " in second.out
    assert "workspace updated: " in second.out
    assert len(server.views) == 2
    assert before.items() <= {name: view["name"] for name, view in server.views.items()}.items()
    # isAuto and the like are the library's, and ours are as they were
    names = [[panel["__id__"] for panel in section["panels"]] for section in sections]
    now = server.spec("project-view")["section"]["panelBankConfig"]["sections"]
    assert [[panel["__id__"] for panel in section["panels"]] for section in now] == names
    assert [section["name"] for section in now] == [section["name"] for section in sections]
    assert len(server.spec("runs")["blocks"]) > 10
    assert "would update the workspace" in dashboards("dry_run=true").out
    server.views.clear()
    third = dashboards()
    assert "report created: " in third.out
    assert "workspace created: " in third.out
    assert len(server.views) == 2


def test_other_runs_and_other_projects_get_their_own(
    dashboards: Callable[..., Ended], server: FakeServer, tmp_path: Path
) -> None:
    for words in ((), ("seed=0,1",), ("seed=0,1", "project=other", "entity=me")):
        assert "created: " in dashboards(*words, "folder=same").out
    assert len(server.views) == 6
    assert sorted(path.name for path in (tmp_path / "same").iterdir()) == ["definition.json", "saved.json"]


def test_a_network_that_is_down_costs_nothing(
    dashboards: Callable[..., Ended], server: FakeServer, tmp_path: Path
) -> None:
    server.down = True
    ended = dashboards()
    assert ended.code == 1
    assert "did not take it (no route to host); the definition is kept in outputs/dashboards/" in ended.err
    assert len(ended.err.strip().splitlines()) == 1
    assert definition(tmp_path / "outputs")["project"] == "apex_lab"
    server.down, server.full = False, True
    assert dashboards().code == 1
    assert [view["type"] for view in server.views.values()] == ["runs"]
    server.full = False
    ended = dashboards()
    assert ended.code == 0
    assert "report updated: " in ended.out
    assert "workspace created: " in ended.out
    assert len(server.views) == 2


@pytest.mark.parametrize(
    ("words", "variable", "reason"),
    [
        (("dry_run=true",), "", "dry_run=true"),
        (("logger=wandb", "logger.wandb.mode=offline"), "", "logger.wandb.mode=offline"),
        ((), "offline", "WANDB_MODE=offline"),
    ],
)
def test_nothing_is_sent_where_that_was_asked_for(
    words: tuple[str, ...],
    variable: str,
    reason: str,
    dashboards: Callable[..., Ended],
    server: FakeServer,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if variable:
        monkeypatch.setenv("WANDB_MODE", variable)
    ended = dashboards(*words)
    assert (ended.code, ended.err) == (0, "")
    assert f"Nothing was sent, since {reason}: this command would create" in ended.out
    assert server.views == {}


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("projet=mine",), "Unknown key projet=mine; did you mean 'project'?"),
        (("dry_run=maybe",), "dry_run"),
        (("modle=apex",), "modle"),
    ],
)
def test_wrong_words_are_refused(
    words: tuple[str, ...], told: str, dashboards: Callable[..., Ended], tmp_path: Path
) -> None:
    ended = dashboards(*words)
    assert ended.code == 2
    assert told in ended.err
    assert list(tmp_path.iterdir()) == []


def test_a_missing_extra_is_named(dashboards: Callable[..., Ended], monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "wandb_workspaces" else real(name))
    ended = dashboards()
    assert ended.code == 2
    assert ended.err.strip().endswith("Dashboards need wandb-workspaces: pip install 'apex_lab[dashboards]'.")


def trial(folder: Path, number: int, sigma_fg: float, sigma_bg: float, logged: bool = True) -> None:
    place = folder / f"apex_p2d_quickstart_{number:08x}" / "seed_0"
    place.mkdir(parents=True)
    likelihood = f"likelihood: {{sigma_fg: {sigma_fg}, sigma_bg: {sigma_bg}}}"
    (place / "config.yaml").write_text(f"model: {{{likelihood}}}\nevaluation: {{split: val}}\n")
    about = {"status": "finished", "data": "p2d", "scale": "quickstart"}
    write_json(place / "run.json", {**about, "wandb_id": "ab12"} if logged else about)


def test_a_study_of_both_sigmas_has_its_panels(dashboards: Callable[..., Ended], tmp_path: Path) -> None:
    studies = tmp_path / "outputs" / "studies"
    for number in range(3):
        trial(studies / "sigma_apex", number, 0.05 * (number + 1), 0.02 * (number + 1))
        trial(studies / "one_key", number, 0.05 * (number + 1), 0.04)
        trial(studies / "not_logged", number, 0.05 * (number + 1), 0.02 * (number + 1), logged=False)
    assert dashboards().code == 0
    found = definition(tmp_path / "outputs" / "dashboards")
    report = json.dumps(found["report"])
    assert "Study sigma_apex, 3 runs on p2d at scale quickstart" in report
    assert "one_key" not in report
    assert "not_logged" not in report
    [points] = [panel for panel in every_panel(found) if panel["viewType"] == "Scatter Plot"]
    config = points["config"]
    assert config["xAxis"] == "config:model.value.likelihood.sigma_fg"
    assert config["yAxis"] == "config:model.value.likelihood.sigma_bg"
    assert config["zAxis"] == "summary:val/ari_fg"
    assert config["xAxisLogScale"] is config["yAxisLogScale"] is True
    assert [f"apex_p2d_quickstart_{number:08x}_seed_0" for number in range(3)] in filters(found)
    assert [panel["viewType"] for panel in every_panel(found)].count("Parallel Coordinates Plot") == 1


@pytest.mark.slow
def test_it_imports_no_pytorch() -> None:
    code = "import sys, apex_lab.dashboards.saving; sys.exit('torch' in sys.modules or 'lightning' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_names_of_folders_and_titles() -> None:
    assert title(["+sweep=ablations", "scale=cpu", "paths.outputs=/a", "logger=wandb"]) == (
        "apex_lab: sweep ablations, scale cpu"
    )
    assert slug(["+sweep=ablations", "scale=cpu", "paths.outputs=/a"]) == "ablations_scale=cpu"
    one, other = (slug(["+sweep=ablations", f"model/apex/masks={'x' * 90}{end}"]) for end in "ab")
    assert one != other
    assert len(one) < 100
