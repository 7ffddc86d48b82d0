"""Memory of a machine and of its control groups; groups are folders made for the test."""

from __future__ import annotations

from pathlib import Path

import psutil
import pytest
import torch

from apex_lab.base import machine


def group(folder: Path, **files: object) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, value in files.items():
        (folder / name.replace("_", ".", 1)).write_text(f"{value}\n")


def test_the_limit_of_every_group_around_a_process_counts(tmp_path: Path) -> None:
    root, own = tmp_path / "fs", tmp_path / "own"
    own.write_text("0::/job/step\n")
    group(root / "job", memory_max=5000, memory_current=1200, memory_stat="anon 900\ninactive_file 200")
    group(root / "job" / "step", memory_max="max", memory_current=1200, memory_stat="anon 900")
    assert list(machine._groups(root, own)) == [(5000, 1000)]


def test_the_older_version_of_groups(tmp_path: Path) -> None:
    root, own = tmp_path / "fs", tmp_path / "own"
    own.write_text("4:memory:/job\n3:cpu,cpuacct:/\n")
    place = root / "memory" / "job"
    group(place, memory_stat="total_inactive_file 50")
    (place / "memory.limit_in_bytes").write_text("700\n")
    (place / "memory.usage_in_bytes").write_text("250\n")
    assert list(machine._groups(root, own)) == [(700, 200)]


def test_no_group_no_limit(tmp_path: Path) -> None:
    assert list(machine._groups(tmp_path, tmp_path / "own")) == []
    assert 0 < machine.free_memory() <= machine.memory() + psutil.swap_memory().total
    assert machine.memory() <= psutil.virtual_memory().total


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="this system has no such bounds")
def test_memory_that_is_not_free_cannot_be_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "free_memory", lambda: 10**8)
    with pytest.raises(RuntimeError, match="can't allocate memory"), machine.bounded_memory():
        torch.empty(10**9, dtype=torch.uint8)
    torch.empty(10**9, dtype=torch.uint8)  # the bound is gone
