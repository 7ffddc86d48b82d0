"""P2D folders keep the bytes that they had before `recordings/`: arrays, manifest, journal, README, fingerprints."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from sims.errors import SimError
from sims.p2d.store import fingerprint
from tests.fakes.p2d_tools import content, make, small

PINNED = json.loads((Path(__file__).resolve().parents[2] / "pinned" / "p2d_folder.json").read_text())
"""SHA-256 of every file of a finished and of an interrupted folder, recorded with the code before `recordings/`."""


def hashes(root: Path) -> dict[str, str]:
    return {name: hashlib.sha256(data).hexdigest() for name, data in content(root).items()}


def test_a_finished_folder_has_the_bytes_of_old(tmp_path: Path) -> None:
    manifest = make(tmp_path)
    assert hashes(tmp_path) == PINNED["finished"]
    assert manifest.content == PINNED["content"]
    assert fingerprint(small()) == manifest.fingerprint == PINNED["fingerprint"]


def test_an_interrupted_folder_has_the_bytes_of_old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE_REFUSE", "train-6")
    with pytest.raises(SimError):
        make(tmp_path)
    assert hashes(tmp_path) == PINNED["unfinished"]
