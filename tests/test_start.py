"""Ctrl-C while a command still starts: it ends by the signal or in its own sentence, without a traceback."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

AT_S = {"apex_lab.train": 0.5, "apex_lab.status": 0.5, "sims.arrangement_clips": 0.2, "sims.p2d": 0.2}
"""Processor seconds: Python itself takes less, the imports of the command more."""


@pytest.mark.parametrize("entry", AT_S)
def test_ctrl_c_during_imports(entry: str, tmp_path: Path) -> None:
    command = subprocess.Popen(
        [sys.executable, "-m", entry, "nonsense"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    process, end = psutil.Process(command.pid), time.monotonic() + 60
    while sum(process.cpu_times()[:2]) < AT_S[entry] and command.poll() is None and time.monotonic() < end:
        time.sleep(0.005)
    command.send_signal(signal.SIGINT)
    said, _ = command.communicate(timeout=60)
    assert "Traceback" not in said
    assert command.returncode in (-signal.SIGINT, 128 + signal.SIGINT, 2), (
        said
    )  # 2: it was quick, and has read its words
