"""Whether another process runs."""

from __future__ import annotations

import os
import subprocess
import sys
import time

from apex_lab.base.processes import alive


def test_alive() -> None:
    assert alive(os.getpid())
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    assert alive(process.pid)
    process.kill()
    began = time.monotonic()
    while alive(process.pid) and time.monotonic() - began < 10:  # a zombie: nobody has waited for it yet
        time.sleep(0.01)
    assert not alive(process.pid)
    process.communicate()
    assert not alive(process.pid)
