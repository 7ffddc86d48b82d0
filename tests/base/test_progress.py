from __future__ import annotations

import time

import pytest

from apex_lab.base import console
from apex_lab.base.progress import Meter


@pytest.fixture(autouse=True)
def _said() -> None:
    console.setup()


def test_lines_come_now_and_then_with_the_time_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    with Meter("step", 100, done=20, seconds=10) as meter:
        for done in range(21, 41):
            now += 1.0
            meter.show(done, f"loss {done}")
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["step 30 of 100, loss 30, 70 seconds left", "step 40 of 100, loss 40, 60 seconds left"]


def test_speed_can_be_measured_anew(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    now = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    with Meter("video", 10, seconds=0) as meter:
        now = 60.0
        meter.restart(1)
        now = 61.0
        meter.show(2)
    assert capsys.readouterr().out == "video 2 of 10, 8 seconds left\n"


def test_a_terminal_gets_a_bar(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    with Meter("video", 3) as meter:
        assert meter.due()
        meter.show(3, "done")
    said = capsys.readouterr()
    assert said.out == ""
    assert "3/3" in said.err
