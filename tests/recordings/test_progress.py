"""Progress without a terminal: plain lines with the time left."""

from __future__ import annotations

import time

import pytest

from recordings.progress import progress


def test_plain_lines_every_15_seconds(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    with progress("checking p2d", 100, "frames") as advance:
        for _ in range(100):
            now += 0.5
            advance(1)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "checking p2d: 100 frames",
        "checking p2d: 30/100 frames (30%), 0:00:35 left",
        "checking p2d: 60/100 frames (60%), 0:00:20 left",
        "checking p2d: 90/100 frames (90%), 0:00:05 left",
        "checking p2d: 100 frames in 0:00:50",
    ]


def test_silence(capsys: pytest.CaptureFixture[str]) -> None:
    with progress("checking p2d", 2, "frames", shown=False) as advance:
        advance(2)
    assert capsys.readouterr().err == ""
