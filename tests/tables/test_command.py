"""`python -m apex_lab.tables` from its first to its last word."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from apex_lab.config import composition
from apex_lab.runs import folder as runs
from tests.conftest import Ended
from tests.tables.folders import run_folder


@pytest.fixture
def tables(command: Callable[..., Ended]) -> Callable[..., Ended]:
    return lambda *words: command("tables", *words)


def test_a_dry_run_on_an_empty_folder_prints_empty_tables_and_every_command(
    tables: Callable[..., Ended], tmp_path: Path
) -> None:
    ended = tables("dry_run=true")
    assert (ended.code, ended.err) == (0, "")
    for number in ("1", "2", "2b", "3", "4"):
        assert f"## Table {number}\n" in ended.out
    assert ended.out.count("python -m apex_lab.train model=") == 15
    assert "python -m apex_lab.train model=scalor seed=0,1,2,3 scale=paper -m " in ended.out
    assert "python -m apex_lab.train model=apex +ablation=no_entropy seed=0,1,2,3 scale=paper -m " in ended.out
    assert list(tmp_path.iterdir()) == []


def fingerprint(*words: str) -> str:
    with initialize_config_dir(version_base="1.3", config_dir=str(composition.conf_dir())):
        return runs.fingerprint(composition.plain(compose("train", overrides=list(words))))


def test_tables_are_printed_stored_and_their_paths_told(tables: Callable[..., Ended], tmp_path: Path) -> None:
    outputs = tmp_path / "my runs"
    own = fingerprint("scale=cpu", "seed=3", "trainer.log_interval=7")
    for seed, value in enumerate((0.5, 0.6)):
        run_folder(outputs, "apex", seed, {"ari": value}, hash8=own[:8], fingerprint=own, scale="cpu")
    run_folder(outputs, "background_subtraction", 0, {"ari": 0.75}, scale="cpu")
    ended = tables("scale=cpu", "tables=[3,1]", f"paths.outputs='{outputs}'")
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.index("## Table 1") < ended.out.index("## Table 3")
    assert "**0.55 ± 0.07** (0.93 ± 0.00)" in ended.out
    assert "- APEX: " not in ended.out  # made by this version's configuration, so nothing is to be said of it
    assert "- Background subtraction: its configuration is not the one that this version's command makes." in ended.out
    assert f"model=apex seed=2,3 scale=cpu 'paths.outputs='\"'\"'{outputs}'\"'\"'' -m" in ended.out
    folder = outputs / "tables" / "p2d_cpu"
    names = ["tables.md", "tables.tex", "tables.json", "table_1.csv", "table_3.csv"]
    assert ended.out.splitlines()[-5:] == [str(folder / name) for name in names]
    assert (folder / "tables.md").read_text() in ended.out
    stored = json.loads((folder / "tables.json").read_text())
    assert [table["number"] for table in stored["tables"]] == ["1", "3"]
    assert (stored["asked"]["scale"], stored["asked"]["seeds"]) == ("cpu", [0, 1, 2, 3])
    assert stored["made_by"]["versions"]["apex_lab"]


def test_the_same_runs_give_the_same_bytes(
    tables: Callable[..., Ended], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("apex_lab.runs.provenance.commit", lambda: ("0" * 40, False))
    run_folder(tmp_path / "outputs", "apex", 0)
    for name in ("one", "two"):
        assert tables("tables=[1]", f"folder={name}").code == 0
    one, two = ({file.name: file.read_text() for file in (tmp_path / name).iterdir()} for name in ("one", "two"))
    two["tables.json"] = two["tables.json"].replace('"folder": "two"', '"folder": "one"')
    assert one == two


def test_damaged_files_are_told_and_do_not_stop_anything(tables: Callable[..., Ended], tmp_path: Path) -> None:
    damaged = run_folder(tmp_path / "outputs", "apex", 0) / "metrics.json"
    damaged.write_text("")
    stranger = run_folder(tmp_path / "outputs", "stranger", 0) / "run.json"
    stranger.write_text("")
    ended = tables("dry_run=true", "tables=[1]")
    assert ended.code == 0
    assert f"- APEX: seed 0 failed: {damaged.relative_to(tmp_path)} cannot be read" in ended.out
    assert f"- {stranger.relative_to(tmp_path)} cannot be read" in ended.out


REFUSED = {
    "tables=[5]": "tables = [5] is wrong: there are 1, 2, 3, 4.",
    "tables=[]": "tables = [] is wrong",
    "seeds=[-1]": "seeds.0 = -1 is wrong",
    "seeds=[1,1]": "seeds = [1, 1] is wrong: name each seed once.",
    "exclude_failed=[gswn]": "exclude_failed: there is no model 'gswn' in op3, scalor, gswm",
    "arrangement_mean=median": "arrangement_mean = 'median' is wrong: input should be 'scenario' or 'object'.",
    "++publish=true": "Unknown key publish = true; did you mean 'published'?",
    "scale=cpuu": "did you mean 'cpu'?",
    "data.frames=3": "data.frames=3 belongs to apex_lab.train; tables take finished runs as they are.",
    "seed=1": "seed=1 belongs to apex_lab.train; tables take finished runs as they are; write seeds=[...].",
    "+model=apex": "+model=apex belongs to apex_lab.train; tables take finished runs as they are.",
    "+ablation=no_entropy": "+ablation=no_entropy belongs to apex_lab.train; tables take finished runs as they are.",
}


@pytest.mark.parametrize("word", REFUSED)
def test_refuses_before_anything_starts(word: str, tables: Callable[..., Ended], tmp_path: Path) -> None:
    ended = tables(word)
    assert (ended.code, ended.out) == (2, "")
    assert REFUSED[word] in ended.err
    assert len(ended.err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_group_that_is_not_there(tables: Callable[..., Ended], tmp_path: Path) -> None:
    ended = tables("groups=[apex_p2d_paper_00000000]")
    assert ended.code == 1
    assert "groups: there are no runs in outputs/apex_p2d_paper_00000000." in ended.err
    assert list(tmp_path.iterdir()) == []


def test_outputs_that_are_a_file(tables: Callable[..., Ended], tmp_path: Path) -> None:
    (tmp_path / "outputs").write_text("")
    ended = tables()
    assert ended.code == 1
    assert "paths.outputs = outputs cannot be read (Not a directory): give a folder of runs." in ended.err
    assert "Traceback" not in ended.err
