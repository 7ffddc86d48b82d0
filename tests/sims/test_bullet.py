"""PyBullet as a module: what loading it does to the process."""

from __future__ import annotations

import subprocess
import sys


def test_loading_pybullet_prints_nothing_and_keeps_what_others_print() -> None:
    code = "print('before'); from sims.bullet import load_pybullet; load_pybullet(); print('after')"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "before\nafter\n", "")
