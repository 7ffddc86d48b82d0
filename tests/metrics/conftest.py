"""The public fixtures: eight small videos with the values that the field's public programs give for them.

`fixtures/metrics_public.npz` holds the videos, `fixtures/metrics_public.json` the expected values, who made each of
them, and the absolute tolerances.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

FIXTURES = Path(__file__).parent / "fixtures"


class PublicVideos:
    def __init__(self) -> None:
        self.expected: dict[str, Any] = json.loads((FIXTURES / "metrics_public.json").read_text())
        self.arrays = dict(np.load(FIXTURES / "metrics_public.npz"))
        self.names: list[str] = self.expected["aggregate"]["order"]

    def truth(self, name: str) -> np.ndarray:
        return self.arrays[f"{name}__gt"].astype(np.int64)

    def slots(self, name: str) -> np.ndarray:
        """Winning slot, (T, H, W)."""
        return self.arrays[f"{name}__masks"].argmax(axis=1)

    def identities(self, name: str) -> np.ndarray:
        """Identity of the winning slot, (T, H, W)."""
        ids = self.arrays[f"{name}__ids"].astype(np.int64)
        frame = np.arange(len(ids))[:, None, None]
        return ids[frame, self.slots(name)]

    def values(self, name: str) -> dict[str, Any]:
        return self.expected["videos"][name]["expected"]


@pytest.fixture(scope="session")
def public() -> PublicVideos:
    return PublicVideos()
