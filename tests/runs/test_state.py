"""The state of a run as other processes read it."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from apex_lab.base.files import write_json
from apex_lab.runs import state
from apex_lab.runs.state import beating, read_state


def folder(place: Path, **record: object) -> Path:
    """A run folder with the given record, whose process shows that it is alive."""
    write_json(place / "run.json", {"host": socket.gethostname(), "pid": os.getpid(), **record})
    (place / ".lock").touch()
    return place


@pytest.mark.parametrize(
    ("record", "expected"),
    [
        ({"status": "running"}, "running"),
        ({"status": "running", "host": "elsewhere", "pid": 1}, "running"),
        ({"status": "failed", "outcome": "failed", "reason": "no disk"}, "failed"),
        ({"status": "failed", "outcome": "diverged", "reason": "no disk"}, "failed"),
        ({"status": "failed", "outcome": "interrupted", "reason": "no disk"}, "interrupted"),
        ({"status": "paused", "outcome": "paused", "reason": "no disk"}, "paused"),
        ({"status": "finished"}, "interrupted"),  # without its scores
        ({"status": "strange"}, "damaged"),
    ],
)
def test_states(record: dict[str, object], expected: str, tmp_path: Path) -> None:
    assert read_state(folder(tmp_path, **record)).state == expected


def test_a_finished_run_has_scores(tmp_path: Path) -> None:
    folder(tmp_path, status="finished", steps=7, seconds=2.5)
    write_json(tmp_path / "metrics.json", {"splits": {"test": {"total": {"ari": 0.5}, "per_video": [{"ari": 0.5}]}}})
    found = read_state(tmp_path)
    assert (found.state, found.steps, found.seconds) == ("finished", 7, 2.5)
    assert read_state(tmp_path, "test").state == "finished"
    assert read_state(tmp_path, "val").state == "interrupted"


@pytest.mark.parametrize(
    ("text", "at_a_look"),
    [
        ('{"splits": {"test": {"total": {"ari": NaN}}}}\n', "finished"),  # as earlier versions wrote it
        ('{"splits": {"test": {"total": {"ari": 0.5}}', "finished"),  # seen only by who reads all of it
        ('{"splits": {"test": {"total": {"ari": 0.5', "interrupted"),
        ('{"splits": {"test": {}}}', "finished"),
        ('{"splits": 3}', "finished"),
        ("", "interrupted"),
        ("\0" * 100, "interrupted"),
    ],
)
def test_results_are_whole(text: str, at_a_look: str, tmp_path: Path) -> None:
    folder(tmp_path, status="finished")
    (tmp_path / "metrics.json").write_text(text)
    assert read_state(tmp_path).state == at_a_look
    found = read_state(tmp_path, "test")
    assert found.state == ("finished" if "NaN" in text else "interrupted")
    assert found.reason == (None if "NaN" in text else "its metrics.json is damaged")


def test_nothing_and_damage(tmp_path: Path) -> None:
    assert read_state(tmp_path / "none").state == "waiting"
    (tmp_path / "run.json").write_text("{")
    assert read_state(tmp_path).state == "damaged"
    (tmp_path / "run.json").write_text("[]")
    assert read_state(tmp_path).state == "damaged"


def test_a_process_that_died_is_lost_at_once(tmp_path: Path) -> None:
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    found = read_state(folder(tmp_path, status="running", pid=gone.pid))
    assert (found.state, found.reason) == ("lost", "its process died without a word")


def test_a_process_of_another_machine_is_lost_without_its_heartbeat(tmp_path: Path) -> None:
    folder(tmp_path, status="running", host="elsewhere")
    old = time.time() - state.LOST - 1
    os.utime(tmp_path / ".lock", (old, old))
    assert read_state(tmp_path).state == "lost"


def test_the_heartbeat(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state, "BEAT", 0.01)
    folder(tmp_path, status="running", host="elsewhere")
    old = time.time() - state.LOST - 1
    with beating(tmp_path):
        os.utime(tmp_path / ".lock", (old, old))
        deadline = time.monotonic() + 10
        while read_state(tmp_path).state == "lost" and time.monotonic() < deadline:
            time.sleep(0.01)
        assert read_state(tmp_path).state == "running"
