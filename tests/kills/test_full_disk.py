"""A full disk: whatever is written then, the result is whole or absent, and the sentence names path and free space."""

from __future__ import annotations

import os
import random
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from apex_lab.runs.state import read_state
from tests.kills import works
from tests.kills.processes import Ended, Measured, Running
from tests.kills.test_kills import SEED, compare
from tests.kills.works import WORKS

Unbroken = Callable[[str], tuple[dict[str, object], Measured]]

FAST = {"training": 40, "evaluation": 10}
"""Command -> writes among which one is drawn; docs/reliability.md names them."""

SLOW = {
    **{"training": 8, "training with pictures": 8, "own videos": 6, "evaluation": 8, "prediction": 10, "sweep": 4},
    **{"simulation": 6, "arrangement clips": 3, "arrangement": 3, "arrangement video": 3},
}
SENTENCE = re.compile(r"(No space left for|writing) .*free there|needs [\d.]+ [MG]B more at .* are free there")


def check(name: str, folder: Path, ended: Ended, told: str) -> None:
    """What must hold after a disk was full."""
    assert ended.code in (1, 2), f"{told}\n{ended.said}"
    assert "Traceback" not in ended.said, f"{told}\n{ended.said}"
    assert SENTENCE.search(ended.said), f"{told}\n{ended.said}"
    assert works.not_whole(folder) == [], told
    states = {str(file.parent): read_state(file.parent).state for file in folder.rglob("run.json")}
    assert "damaged" not in states.values(), (states, told)


@pytest.mark.parametrize("name", FAST)
def test_no_write_succeeds_after_a_random_one(name: str, tmp_path: Path, inputs: Path, unbroken: Unbroken) -> None:
    """Without rights of any kind: writing fails inside Python."""
    work, (expected, _) = WORKS[name], unbroken(name)
    draw, folder = random.Random(f"{SEED} writes {name}"), tmp_path / "disk"
    folder.mkdir()
    words = [word.replace("{inputs}", str(inputs)) for word in work.words]
    writes = draw.randrange(0, FAST[name])
    ended = Running(work.entry, words, folder, variables=work.variables, writes=writes).end(work.workers)
    check(name, folder, ended, f"{name}, seed {SEED}, full after {writes} writes")
    assert Running(work.entry, words, folder, variables=work.variables).end().code == 0
    compare(work, folder, expected, f"{name}, seed {SEED}")


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A real file system of its own in memory."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("only root may mount a file system")
    command = ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(folder)]
    if subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip("may not mount a file system here")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", SLOW)
def test_a_disk_with_too_little_room(name: str, disk: Path, inputs: Path, unbroken: Unbroken, tmp_path: Path) -> None:
    """Output and data lie on it; again and again it has room for a random part of them."""
    work, (expected, _) = WORKS[name], unbroken(name)
    draw = random.Random(f"{SEED} disk {name}")
    words = [word.replace("{inputs}", str(inputs)) for word in work.words]
    place = disk / "work"
    place.mkdir()
    ended = Running(work.entry, words, place, variables=work.variables, logs=tmp_path).end()
    assert ended.code == 0, ended.said
    needed = sum(path.stat().st_blocks * 512 for path in place.rglob("*") if path.is_file())
    full, early = 0, 0
    for _ in range(SLOW[name]):
        if ended.code == 0:
            shutil.rmtree(place)
            place.mkdir()
        room = draw.randrange(0, needed)
        ballast = disk / ".ballast"
        _fill(ballast, shutil.disk_usage(disk).free - room)
        ended = Running(work.entry, words, place, variables=work.variables, logs=tmp_path).end()
        told = f"{name}, seed {SEED}, {room} of {needed} bytes free"
        ballast.unlink()
        if ended.code == 0:
            early += 1
            compare(work, place, expected, told)
        else:
            full += 1
            check(name, place, ended, told)
    ended = Running(work.entry, words, place, variables=work.variables, logs=tmp_path).end()
    assert ended.code == 0, ended.said
    compare(work, place, expected, f"{name}, seed {SEED}")
    print(f"{name} seed {SEED}: the disk was full {full} times, sufficed {early} times")
    assert full


def _fill(path: Path, size: int) -> None:
    with open(path, "wb") as file:
        os.posix_fallocate(file.fileno(), 0, max(size, 1))
