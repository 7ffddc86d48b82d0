"""Files of a run that are lost or damaged: it goes on, and its tables are what they were."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from apex_lab.evaluation.score import Tally
from apex_lab.tables.found import SeedRun, read_run
from tests.conftest import Ended
from tests.test_train import curves, record, weights

DAMAGED = {
    "empty": b"",
    "cut off": b'{"status": "fini',
    "binary": bytes(range(256)),
    "no object": b"[1, 2]",
    "of other types": b'{"status": "failed", "history": "long", "steps": "many"}',
}


def interrupted(train: Callable[..., Ended], monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    monkeypatch.setenv("TINY_BROKEN_AT", "5")
    assert train(*words).code == 1
    monkeypatch.delenv("TINY_BROKEN_AT")


def as_in_tables(run: Path) -> dict[str, Any]:
    """All that tables take from a run's folder; when it was started is told from the history."""
    found = read_run(run, 0)
    assert isinstance(found, SeedRun)
    about = record(run)
    return {
        **{name: getattr(found, name) for name in ("state", "why", "scores", "protocol", "share", "failure")},
        "record": found.record,
        **{name: about[name] for name in ("steps", "seconds", "started", "data_fingerprint")},
        "starts": about["history"],
    }


@pytest.mark.parametrize("damage", [None, "of other types"])
def test_a_finished_run_that_lost_its_record_has_the_same_place_in_tables(
    damage: str | None, train: Callable[..., Ended], the_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Tally, "mean_share", lambda self: 0.0)  # a seed that has failed
    assert train().code == 0
    before = as_in_tables(the_run())
    assert before["failure"] == "it gives 0.000 % of the validation pixels to objects"
    assert (before["steps"], before["seconds"] > 0) == (6, True)
    file = the_run() / "run.json"
    if damage is None:
        file.unlink()
    else:
        file.write_bytes(DAMAGED[damage])
    monkeypatch.undo()
    monkeypatch.chdir(the_run().parents[2])
    ended = train()
    assert ended.code == 0
    assert ("is damaged and was set aside as run.damaged.json" in ended.err) == (damage is not None)
    after = as_in_tables(the_run())
    assert after.pop("starts")[:1] == before.pop("starts")
    assert after == before


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_damaged_record_is_set_aside(
    damage: str, train: Callable[..., Ended], the_run: Callable[..., Path], tmp_path: Path
) -> None:
    from apex_lab.runs.folder import Run
    from tests.conftest import compose_job

    with Run(compose_job()) as run:
        run.record_file.write_bytes(DAMAGED[damage])
    with Run(compose_job()) as run:
        assert run.record == {}
    assert (run.folder / "run.damaged.json").read_bytes() == DAMAGED[damage]


def test_the_data_are_compared_though_the_record_is_lost(
    train: Callable[..., Ended], the_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted(train, monkeypatch)
    (the_run() / "run.json").unlink()
    monkeypatch.setattr("tests.tiny.SquaresSource.fingerprint", "0" * 32)
    ended = train()
    assert ended.code == 1
    assert "was started with other data" in ended.err


def test_all_that_is_damaged_at_once_costs_nothing_but_curves(
    train: Callable[..., Ended], the_run: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert train("paths.outputs=whole").code == 0
    whole = next(tmp_path.glob("whole/*/seed_0"))
    interrupted(train, monkeypatch)
    run = the_run()
    for name in ("run.json", "curves.csv", "config.yaml", "log.txt", "metrics.json", "checkpoints/previous.ckpt"):
        (run / name).write_bytes(DAMAGED["binary"])
    ended = train()
    assert ended.code == 0
    assert sorted(path.name for path in run.glob("*.damaged*")) == [
        "curves.damaged.csv",
        "metrics.damaged.json",
        "run.damaged.json",
    ]
    said = ended.err.splitlines()
    assert len(said) == 3, said
    assert "curves.csv is damaged and was set aside as curves.damaged.csv; 0 rows of it are whole." in ended.err
    ours, theirs = weights(run), weights(whole)
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    ours, theirs = (as_in_tables(path) for path in (run, whole))
    for name in ("state", "scores", "protocol", "share", "failure", "steps", "data_fingerprint"):
        assert ours[name] == theirs[name], name
    assert [row["step"] for row in curves(run)] == ["5", "6"]  # those before lie in the damaged file
    assert (run / "log.txt").read_bytes().startswith(DAMAGED["binary"])


@pytest.mark.parametrize(
    "text",
    ['{"splits": {"val": {}}}', *(pytest.param(t, marks=pytest.mark.slow) for t in ("{", "{}", '{"splits": 3}'))],
)
def test_damaged_results_of_a_finished_run_are_made_again(
    text: str, trained: Path, train: Callable[..., Ended]
) -> None:
    before = as_in_tables(trained)
    (trained / "metrics.json").write_text(text)
    assert train().code == 0
    after = as_in_tables(trained)
    assert after.pop("starts")[:1] == before.pop("starts")
    assert after == before


def test_a_run_of_format_1_is_found_without_its_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import shutil

    import yaml

    from apex_lab.config.job import check_job
    from apex_lab.config.upgrades import upgraded
    from apex_lab.runs.folder import run_folder
    from tests.conftest import REPOSITORY

    monkeypatch.chdir(tmp_path)
    [old] = (REPOSITORY / "tests" / "pinned" / "format_1").glob("**/run.json")
    choices = json.loads(old.read_text())
    folder = tmp_path / "outputs" / old.parent.parent.name / old.parent.name
    shutil.copytree(old.parent, folder)
    raw = upgraded(yaml.safe_load((old.parent / "config.yaml").read_text()), 1)
    raw["paths"]["outputs"] = "outputs"
    words = {group: choices[group] for group in ("model", "ablation", "data", "scale") if choices[group]}
    job = check_job(raw, words, needs_recipe=False)
    assert run_folder(job).resolve() == folder
    (folder / "run.json").unlink()
    assert run_folder(job).resolve() == folder


def test_tables_are_the_same_after_their_advice_was_followed(command: Callable[..., Ended], tmp_path: Path) -> None:
    words = ("model=apex", "data=sprites", "scale=smoke", "trainer.max_steps=2", "evaluation.pictures=0")
    assert command("train", *words).code == 0
    [run] = tmp_path.glob("outputs/*/seed_0")
    tables = ("+sweep=arrangement", *words, "tables=[1]", "dry_run=true")
    before = command("tables", *tables)
    assert before.code == 0, before.err
    assert "APEX" in before.out
    (run / "run.json").write_text("{")
    told = command("tables", *tables).out
    assert "run.json cannot be read" in told
    assert "run the same command again, which sets it aside" in told
    assert command("train", *words).code == 0
    assert (run / "run.damaged.json").is_file()
    assert command("tables", *tables).out == before.out
