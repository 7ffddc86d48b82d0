"""Slots: how a machine is divided, who gets which, and what a process in one may use."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from apex_lab.base import slots
from apex_lab.base.slots import Slot, claimed, divided, visible_gpus


@pytest.mark.parametrize(
    ("number", "cores", "gpus", "right"),
    [
        (1, 4, 0, [((0, 1, 2, 3), ())]),
        (2, 4, 2, [((0, 1), ("0",)), ((2, 3), ("1",))]),
        (2, 5, 4, [((0, 1), ("0", "1")), ((2, 3, 4), ("2", "3"))]),
        (3, 2, 1, [((0,), ("0",)), ((0,), ("0",)), ((1,), ("0",))]),
        (4, 8, 2, [((0, 1), ("0",)), ((2, 3), ("0",)), ((4, 5), ("1",)), ((6, 7), ("1",))]),
    ],
)
def test_a_machine_is_divided_evenly(number: int, cores: int, gpus: int, right: list[tuple]) -> None:
    made = divided(number, range(cores), [str(gpu) for gpu in range(gpus)])
    assert [(slot.cores, slot.gpus) for slot in made] == right


def test_a_slot_has_one_owner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slots, "POLL", 0.0)
    two = divided(2, [0])  # both hold the same core
    looks = 0

    def idle() -> None:
        nonlocal looks
        looks += 1
        raise TimeoutError

    with claimed(two, tmp_path) as first, claimed(two, tmp_path) as second:
        assert first == second == Slot((0,))
        with pytest.raises(TimeoutError), claimed(two, tmp_path, idle):
            pass
    assert looks == 1
    with claimed(two, tmp_path, idle):
        pass


def test_a_slot_is_free_when_its_owner_is_killed(tmp_path: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from apex_lab.base.slots import *\n"
        "with claimed([Slot((0,))], Path(sys.argv[1])): print('mine', flush=True); time.sleep(60)"
    )
    owner = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE)
    assert owner.stdout is not None
    assert owner.stdout.readline() == b"mine\n"

    def taken() -> None:
        raise TimeoutError

    with pytest.raises(TimeoutError), claimed([Slot((0,))], tmp_path, taken):
        pass
    owner.kill()
    owner.communicate()
    with claimed([Slot((0,))], tmp_path, taken) as slot:
        assert slot == Slot((0,))


def test_the_gpus_that_a_process_may_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for given, right in {"": [], "-1": [], "2, 3": ["2", "3"], "GPU-8932f937": ["GPU-8932f937"]}.items():
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", given)
        assert visible_gpus() == right
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    tool = tmp_path / "nvidia-smi"
    monkeypatch.setenv("PATH", str(tmp_path))
    assert visible_gpus() == []
    tool.write_text("#!/bin/sh\necho 0\necho 1\n")
    tool.chmod(0o755)
    assert visible_gpus() == ["0", "1"]
    tool.write_text("#!/bin/sh\necho no driver\nexit 9\n")
    assert visible_gpus() == []
    assert Slot((0, 1), ("2", "3")).environment["CUDA_VISIBLE_DEVICES"] == "2,3"
    assert "CUDA_VISIBLE_DEVICES" not in Slot((0, 1)).environment


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system pins no processes")
def test_a_process_is_kept_on_its_cores() -> None:
    [slot] = divided(1, sorted(os.sched_getaffinity(0))[:1])
    code = "import os; input(); print(os.sched_getaffinity(0))"
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    slot.pin(process.pid)
    out, _ = process.communicate("\n")
    assert out == f"{set(slot.cores)}\n"
    slot.pin(process.pid)  # a process that has ended is left alone
