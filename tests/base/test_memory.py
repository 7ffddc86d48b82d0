"""Memory that is freed stays with the process: in a process of its own, since the setting is for good."""

from __future__ import annotations

import resource
import subprocess
import sys

import pytest

MEASURE = """
import resource, sys, torch
from apex_lab.base.memory import keep_freed_memory
if not keep_freed_memory():
    sys.exit(3)
def work():
    return [torch.zeros(2**20) for _ in range(20)]
for _ in range(4):
    work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5):
    work()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults() -> int:
    ended = subprocess.run([sys.executable, "-c", MEASURE], capture_output=True, text=True, check=False)
    if ended.returncode == 3:
        pytest.skip("the allocator is not glibc's")
    assert ended.returncode == 0, ended.stderr
    return int(ended.stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's allocator")
def test_blocks_of_megabytes_are_reused_without_page_faults() -> None:
    pages = 5 * 20 * 2**22 // resource.getpagesize()
    assert faults() < pages / 100
