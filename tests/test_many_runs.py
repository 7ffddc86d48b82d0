"""Many runs: every file is read once, and with 2,000 of them every command says something within five seconds."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from apex_lab.runs.listed import listed
from tests.conftest import Ended
from tests.tables.folders import SCORES

VIDEOS = 200
"""Rows per video in every result, as at the paper's scale; they make nearly all of the file."""


def finished_runs(outputs: Path, words: list[str], videos: int) -> int:
    """Writes the finished run of every job of a command line; how many."""
    scores = {f"{key}_{number}": 0.123456789012345 for key in SCORES for number in range(3)}
    rows = [{"video": f"test_{number:05d}", **scores} for number in range(videos)]
    split = {"videos": videos, "frames": 20 * videos, "total": {"videos": videos, **SCORES}, "per_video": rows}
    results = json.dumps({"settings": {"scoring": {}}, "versions": {}, "splits": {"test": split}}, indent=2)
    jobs = listed([*words, f"paths.outputs={outputs}"])
    for job in jobs:
        job.folder.mkdir(parents=True)
        about: dict[str, Any] = {
            "format": 2,
            "status": "finished",
            "outcome": "finished",
            "seed": job.seed,
            "steps": 40_000,
            "seconds": 9000.0,
            "fingerprint": job.fingerprint,
            "data_fingerprint": "d" * 32,
            "foreground_share": 0.3,
            "versions": {f"package_{number}": "1.2.3" for number in range(15)},
            "history": [{"started": "2026-01-01T00:00:00+00:00", "command": " ".join(job.words)}],
        }
        (job.folder / "run.json").write_text(json.dumps(about, indent=2))
        (job.folder / "metrics.json").write_text(results)
    return len(jobs)


def test_every_file_is_read_once(
    command: Callable[..., Ended], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["+sweep=arrangement", "model=apex,oracle", "scale=smoke", "seed=range(0,5)"]
    assert finished_runs(tmp_path / "outputs", words, videos=1) == 10
    reads: Counter[str] = Counter()
    for name in ("read_text", "read_bytes"):
        method = getattr(Path, name)

        def counted(path: Path, *rest: Any, _method: Any = method, **named: Any) -> Any:
            reads.update([path.name])
            return _method(path, *rest, **named)

        monkeypatch.setattr(Path, name, counted)
    ended = command("status", *words, "--once")
    assert "10 jobs: 10 finished." in ended.out
    assert (reads["run.json"], reads["metrics.json"]) == (10, 0)
    reads.clear()
    ended = command("tables", *words, "tables=[1]", "dry_run=true")
    assert ended.code == 0
    assert (reads["run.json"], reads["metrics.json"]) == (10, 10)
    reads.clear()
    assert "10 jobs: 10 finished." in command("status", "--once").out
    assert (reads["run.json"], reads["metrics.json"], reads["config.yaml"]) == (10, 0, 0)


@pytest.mark.slow
def test_two_thousand_runs_take_less_than_five_seconds(trained: Path, tmp_path: Path) -> None:
    words = ["+sweep=paper", "seed=range(0,91)"]
    outputs = tmp_path / "many"
    assert finished_runs(outputs, words, VIDEOS) == 2002
    for folder in outputs.glob("*/seed_*"):
        (folder / "checkpoints").mkdir()
        for name in ("last.ckpt", "best.ckpt"):
            os.link(trained / "checkpoints" / name, folder / "checkpoints" / name)
        for name in ("curves.csv", "config.yaml"):
            os.link(trained / name, folder / name)
    place = f"paths.outputs={outputs}"
    for asked in (["status", *words, place, "--once"], ["status", place, "--once"]):
        seconds = min(_seconds(asked, tmp_path) for _ in range(2))
        print(f"{' '.join(asked)}: {seconds:.1f} s")
        assert seconds < 5.0, asked
    for asked in (
        *(["status", *words, place, "--once"], ["status", place, "--once"]),
        *(["tables", *words, place], ["report", *words, place]),
        ["evaluate", f"checkpoint={outputs}", "trust=true"],
    ):
        seconds, line = min(_first_line(asked, tmp_path) for _ in range(2))
        print(f"{' '.join(asked)}: first line after {seconds:.1f} s: {line}")
        assert seconds < 5.0, asked
        assert "2002" in line


def _first_line(asked: list[str], folder: Path) -> tuple[float, str]:
    """Processor time of a command until its first line, and that line; the command is ended then."""
    program = [sys.executable, "-m", f"apex_lab.{asked[0]}", *asked[1:]]
    with subprocess.Popen(program, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        seconds = sum(psutil.Process(process.pid).cpu_times()[:2])
        process.kill()
    return seconds, line.strip()


def _seconds(asked: list[str], folder: Path) -> float:
    """Processor time of a command: what an idle machine takes, whatever else this one is doing."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    program = [sys.executable, "-m", f"apex_lab.{asked[0]}", *asked[1:]]
    ended = subprocess.run(program, cwd=folder, capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0, ended.stderr
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
