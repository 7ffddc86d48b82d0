"""The benchmark runs, and P2D is far faster than a straightforward scene."""

from __future__ import annotations

import signal
import sys

import pytest

pytest.importorskip("pybullet")

from sims.p2d import bench_simulation as bench
from sims.p2d.settings import Settings


def test_it_counts_frames_and_prints_the_ratio(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["bench", "--trajectories", "1", "--image-size", "32"])
    assert bench.main() == 0
    said = capsys.readouterr().out
    assert "frames per second and core" in said
    assert "minutes for 48000 frames on 2 core(s)" in said


def test_a_request_to_stop_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["bench"])
    monkeypatch.setattr(bench, "measure", lambda *_: signal.raise_signal(signal.SIGTERM))
    assert bench.main() == 128 + signal.SIGTERM
    assert capsys.readouterr().err == "terminated; nothing is stored\n"


@pytest.mark.slow
def test_p2d_is_much_faster_than_the_naive_scene() -> None:
    naive, product = bench.measure(Settings(), 6)
    assert naive.frames == product.frames == 120
    # The bar is 6 on a quiet machine; other work at the same time slows short calls more than long ones.
    assert product.per_core / naive.per_core > 4
