"""What stands in a row: seeds of one configuration, found by their identity, with scores that can be compared."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from apex_lab.runs.listed import Listed
from apex_lab.tables.configurations import Configuration, configurations, plain_words
from tests.tables.folders import job, made, run_folder


def only(*jobs: Listed, **plain: str) -> Configuration:
    (found,) = configurations(jobs, {tuple(words.split()): identity for words, identity in plain.items()})
    return found


def seeds(outputs: Path, *numbers: int) -> list[Listed]:
    return [job(outputs, "apex", seed) for seed in numbers]


def test_seeds_of_one_configuration_make_a_row_in_the_order_of_the_jobs(tmp_path: Path) -> None:
    run_folder(tmp_path, "apex", 2)
    one, other = seeds(tmp_path, 2, 0), job(tmp_path, "apex", 0, "gaussian")
    found = configurations([one[0], other, one[1]], {})
    assert [(each.row, each.seeds) for each in found] == [(("apex", None), (2, 0)), (("apex", "gaussian"), (0,))]
    assert sorted(found[0].runs) == [2]
    assert found[0].folder == "apex_p2d_paper_0123abcd"
    assert found[1].folder == found[1].name


def test_words_that_change_no_value_are_not_told(tmp_path: Path) -> None:
    changed = job(tmp_path, "apex", 0, words=("trainer.max_steps=9", "trainer.log_interval=2", "paths.data=x"))
    assert changed.changes == ("trainer.max_steps=9",)
    assert only(changed).changes == ("trainer.max_steps=9",)
    assert plain_words(changed) == ("model=apex", "data=p2d", "scale=paper")
    assert only(changed, **{"model=apex data=p2d scale=paper": changed.fingerprint}).changes == ()
    assert only(changed, **{"model=apex data=p2d scale=paper": "0" * 64}).changes == ("trainer.max_steps=9",)


@pytest.mark.parametrize(
    ("odd", "told"),
    [
        ({"data_fingerprint": "e" * 32}, "other data (fingerprint eeeeeeee) than for the other seeds."),
        ({"data_fingerprint": None}, "other data (fingerprint unknown) than for the other seeds."),
        ({"videos": 100}, "other videos (100 with 2000 frames) than for the other seeds."),
        ({"metrics": {"settings": {"scoring": None}}}, "other settings of the evaluation than for the other seeds."),
    ],
)
def test_seeds_that_cannot_stand_beside_the_others_are_left_out(odd: dict[str, Any], told: str, tmp_path: Path) -> None:
    for seed in (0, 2):
        run_folder(tmp_path, "apex", seed, {"ari": 0.5})
    run_folder(tmp_path, "apex", 1, {"ari": 1.0}, **odd)
    found = only(*seeds(tmp_path, 0, 1, 2))
    assert sorted(found.runs) == [0, 2]
    assert found.left_out == {1: told}
    (table,), _ = made(tmp_path)
    line = table.lines[-1]
    summary = line.cells["ari"].summary
    assert summary is not None
    assert (summary.n, summary.mean) == (2, 0.5)
    assert line.seeds == "2 of 4"
    assert f"seed 1 is left out: {told}" in line.notes


def test_a_folder_that_holds_another_run_than_its_name_tells(tmp_path: Path) -> None:
    folder = run_folder(tmp_path, "apex", 0, format=2, fingerprint="f" * 64)
    found = only(*seeds(tmp_path, 0))
    assert (found.runs, found.left_out) == ({}, {0: f"{folder} holds another configuration than its name tells."})


def test_damage_keeps_its_row(tmp_path: Path) -> None:
    (run_folder(tmp_path, "apex", 0) / "run.json").write_text("{")
    (run_folder(tmp_path, "apex", 1) / "metrics.json").write_text("{")
    assert {seed: run.state for seed, run in only(*seeds(tmp_path, 0, 1)).runs.items()} == {0: "damaged", 1: "damaged"}


def test_a_large_result_is_read_as_json_reads_it(tmp_path: Path) -> None:
    folder = run_folder(tmp_path, "apex", 0)
    before = only(*seeds(tmp_path, 0)).runs[0]
    content = json.loads((folder / "metrics.json").read_text())
    content["splits"]["test"]["per_video"] = [{"video": f"test_{n}", "ari": float(n)} for n in range(100)]
    content["odd"] = float("nan")  # which the fast reader refuses
    (folder / "metrics.json").write_text(json.dumps(content))
    assert only(*seeds(tmp_path, 0)).runs[0] == before
