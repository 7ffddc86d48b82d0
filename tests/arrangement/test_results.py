"""Stored scenarios and their summary, by hand-made outcomes."""

from __future__ import annotations

import dataclasses
import json
import statistics
from pathlib import Path
from typing import Any

import pytest

from apex_lab.arrangement.results import Store, identity, summary, table, write
from apex_lab.arrangement.task import Setting, Task
from apex_lab.tables.found import SeedRun, read_arrangement, read_failures
from sims.arrangement.settings import Settings

SETTING = Setting({"_target_": "x", "min_presence": 0.5}, None, "ab", False, "cpu", Settings(), 0)


def outcome(index: int, distances: list[float], reasons: list[str | None], retries: int = 0) -> dict[str, Any]:
    objects = [{"name": "mug", "distance_m": d, "reason": r} for d, r in zip(distances, reasons, strict=True)]
    subtask = {"object": "mug", "goal": 0, "kind": "home", "attempts": 1, "failure": None, "time_s": 5.0}
    return {
        "task": len(distances),
        "index": index,
        "objects": objects,
        "subtasks": [subtask, {**subtask, "attempts": 1 + retries}],
        "time_s": 20.0,
        "ended": "arranged",
        "seconds": 4.0,
    }


def test_a_summary_is_the_paper_s_table_and_what_tables_read(tmp_path: Path) -> None:
    outcomes = {
        2: [outcome(0, [0.01, 0.03], [None, None]), outcome(1, [1.0, 0.2], ["fell", "wrong match"], retries=1)],
        3: [outcome(0, [0.0, 0.0, 0.3], [None, None, "fell"])],
    }
    found = summary(outcomes)
    two = found["tasks"]["2"]
    assert two["mean_m"] == pytest.approx(0.31)
    assert two["std_m"] == pytest.approx(statistics.stdev([0.02, 0.6]))
    assert (two["scenarios"], two["objects"], two["lost"], two["median_m"]) == (2, 4, 1, pytest.approx(0.115))
    assert two["failures"] == {"fell": 1, "wrong match": 1}
    assert (two["subtasks"], two["without_retry"], two["ended"]) == (4, 3, {"arranged": 2})
    assert found["tasks"]["3"]["std_m"] is None
    paths = write(tmp_path, "APEX", found)
    run = SeedRun(tmp_path, 0, None, "finished")
    assert read_arrangement(run) == {"2": [[0.01, 0.03], [1.0, 0.2]], "3": [[0.0, 0.0, 0.3]]}
    assert read_failures(run) == {"2": (2, 4, {"fell": 1, "wrong match": 1}), "3": (1, 3, {"fell": 1})}
    text = paths[1].read_text()
    assert text == table("APEX", found)
    assert "| 2 | 2 | 0.310 ± 0.410 | 0.115 | 2 of 4 | 1 | 3 of 4 | 20 s |" in text
    assert "- 3 objects, 1 of 3 away from home: fell 1" in text


def test_a_stored_outcome_counts_only_if_it_is_whole_and_of_the_same_identity(tmp_path: Path) -> None:
    store, task = Store(tmp_path, "key"), Task(2, 1)
    assert store.read(task) is None
    store.write(task, outcome(1, [0.1, 0.2], [None, None]))
    assert store.file(task).name == "2_001.json"
    content = store.read(task)
    assert content is not None
    assert content["objects"][1]["distance_m"] == 0.2
    assert Store(tmp_path, "other").read(task) is None
    text = store.file(task).read_text()
    for damaged in (text[:-20], "[]", json.dumps({**content, "objects": [{}]}), json.dumps({**content, "index": 2})):
        store.file(task).write_text(damaged)
        assert store.read(task) is None


def test_whatever_can_change_an_outcome_changes_the_identity() -> None:
    others = [
        dataclasses.replace(SETTING, perception={"_target_": "x", "min_presence": 0.4}),
        dataclasses.replace(SETTING, digest="cd"),
        dataclasses.replace(SETTING, device="cuda"),
        dataclasses.replace(SETTING, world=Settings(max_attempts=2)),
        dataclasses.replace(SETTING, seed=1),
    ]
    assert len({identity(setting) for setting in (SETTING, *others)}) == 6
    assert identity(dataclasses.replace(SETTING, checkpoint=Path("elsewhere.ckpt"))) == identity(SETTING)
