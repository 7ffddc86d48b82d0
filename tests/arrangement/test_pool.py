"""Workers that die, stop or fail, and those that have done enough."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import psutil
import pytest

from apex_lab.arrangement.pool import TRIES, Pool
from apex_lab.arrangement.task import Failure, Setting, Task
from apex_lab.base.interrupts import Interrupted, interruptible
from sims.arrangement.settings import Settings
from tests.arrangement.workers import serve


def made(folder: Path, size: int = 1, **more: float) -> Pool:
    setting = Setting({"log": str(folder / "log")}, None, None, False, "cpu", Settings(), 0)
    return Pool(setting, size, work=serve, **more)  # type: ignore[arg-type]


def attempts(folder: Path, task: str) -> int:
    return (folder / "log").read_text().splitlines().count(task)


def test_killed_stopped_and_failing_workers(tmp_path: Path) -> None:
    # 0 and 5 go well, 1 kills its worker once, 2 stops it once, 3 always ends it, 4 fails
    tasks = [Task(2, index) for index in range(6)]
    found = dict(made(tmp_path, size=2, patience_s=8.0).run(tasks))
    assert set(found) == set(tasks)
    for index in (0, 1, 2, 5):
        answer = found[Task(2, index)]
        assert isinstance(answer, dict)
        assert answer["environment"] == "0"
        assert answer["process"] != os.getpid()
    assert found[Task(2, 3)] == Failure(f"its worker ended with exit code 7, {TRIES} times")
    assert found[Task(2, 4)] == Failure("ValueError: no", "a traceback")
    assert [attempts(tmp_path, f"2/{index}") for index in range(6)] == [1, 2, 2, TRIES, 1, 1]
    assert not [child for child in psutil.Process().children() if "spawn_main" in " ".join(child.cmdline())]


def test_workers_are_replaced_when_they_have_done_enough(tmp_path: Path) -> None:
    found = dict(made(tmp_path, recycle=2).run([Task(5, index) for index in (0, 5, 6)]))
    processes = [answer["process"] for answer in found.values() if isinstance(answer, dict)]
    assert (len(processes), processes[0] == processes[1], processes[1] == processes[2]) == (3, True, False)


def test_a_request_to_stop_ends_all_workers_at_once(tmp_path: Path) -> None:
    pid = os.getpid()

    def ask() -> None:
        while not (tmp_path / "log").exists():
            time.sleep(0.05)
        os.kill(pid, 15)

    began = time.monotonic()
    asking = threading.Thread(target=ask)
    with pytest.raises(Interrupted), interruptible():  # noqa: PT012 - the signal may come anywhere inside
        asking.start()
        for _ in made(tmp_path).run([Task(3, 9)]):
            raise AssertionError("it sleeps for a minute")
    asking.join()
    assert time.monotonic() - began < 50
    assert not [child for child in psutil.Process().children() if "spawn_main" in " ".join(child.cmdline())]
