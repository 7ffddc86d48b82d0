"""The bytes of a tiny data set, recorded once: the same on every Python and with every build of PyBullet."""

from __future__ import annotations

import platform
from pathlib import Path

import pytest

pytest.importorskip("pybullet")

from sims.p2d.generate import generate
from sims.p2d.settings import Settings
from sims.p2d.store import fingerprint

SETTINGS = Settings(train=2, val=1, test=1, frames=3, image_size=32)
FINGERPRINT = "a1ef5abd443cf621"
CONTENT = "c5ae76653c94d6561cdc9fd17573f305"
"""Recorded with pybullet 3.2.7 on Python 3.11.7. The same with OpenBLAS kernels for AVX2 and AVX-512; processors
without FMA round differently."""


def test_fingerprints_stay() -> None:
    assert fingerprint(SETTINGS) == FINGERPRINT
    assert fingerprint(Settings()) == "c3147c00c58b7e2f"


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="recorded on x86-64")
def test_bytes_of_a_tiny_data_set(tmp_path: Path) -> None:
    manifest = generate(tmp_path, SETTINGS, workers=1, shown=False)
    assert manifest.fingerprint == FINGERPRINT
    assert manifest.content == CONTENT, (
        f"the simulator gives other bytes than those recorded, with {manifest.facts['versions']}: raise "
        "SIMULATION_VERSION if the change is wanted, else find the package that changed"
    )
