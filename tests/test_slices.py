"""A run from nothing to its row in a table, in slices of time, each a command of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.test_train import record, weights, without_speed

APEX = ("model=apex", "data=p2d", "scale=smoke", "trainer=cpu", "data.workers=0", "trainer.max_steps=5")


def done(folder: Path, entry: str, *words: str) -> str:
    """What a command has said, run to its end in a process of its own."""
    command = [sys.executable, "-m", f"apex_lab.{entry}", *words]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def row(folder: Path) -> str:
    """The run's row in table 1."""
    said = done(folder, "tables", "model=apex", "scale=smoke", "trainer.max_steps=5", "tables=[1]", "published=false")
    [found] = [line for line in said.splitlines() if line.startswith("| APEX")]
    return found


@pytest.mark.slow
def test_from_nothing_to_a_table_in_slices(tmp_path: Path) -> None:
    """Data are made in the first slice, whose time they use up; each slice makes one step at least."""
    few = "trainer.max_minutes=1e-6"
    for step in range(1, 5):
        assert f"paused at step {step}: " in done(tmp_path, "train", *APEX, few)
    assert "0 of 4" in row(tmp_path)
    done(tmp_path, "train", *APEX, few)  # the last step, scores and pictures
    done(tmp_path, "train", *APEX, "paths.outputs=whole")
    sliced, whole = (next((tmp_path / name).glob("*/seed_0")) for name in ("outputs", "whole"))
    assert [(record(run)["status"], record(run)["steps"]) for run in (sliced, whole)] == [("finished", 5)] * 2
    ours, theirs = weights(sliced), weights(whole)
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    assert without_speed(sliced) == without_speed(whole)
    scores = [json.loads((run / "metrics.json").read_text())["splits"]["test"]["total"] for run in (sliced, whole)]
    assert scores[0] == scores[1]
    assert "1 of 4" in row(tmp_path)
    assert f"{scores[0]['msc_fg']:.2f}" in row(tmp_path)
