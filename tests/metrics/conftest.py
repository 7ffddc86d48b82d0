"""The public fixtures: eight small videos with the values that the field's public programs give for them.

`fixtures/metrics_public.npz` holds the videos, `fixtures/metrics_public.json` the expected values, who made each of
them, and the absolute tolerances.
"""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from apex_lab.metrics.bench_scoring import synthetic_video
from apex_lab.metrics.contingency import contingency

FIXTURES = Path(__file__).parent / "fixtures"
VIDEO_NAMES = (
    "perfect",
    "id_switch",
    "split_half",
    "empty_prediction",
    "single_object",
    "occlusion_new_id",
    "soft_ties",
    "background_split",
)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """A test that takes `video` runs on every public one."""
    if "video" in metafunc.fixturenames:
        metafunc.parametrize("video", VIDEO_NAMES)


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


def some_videos(n: int, frames: int = 8, side: int = 48) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Name -> (prediction, truth) of n synthetic videos with different numbers of objects."""
    return {f"v{i}": synthetic_video(i, frames, side, 1 + i % 4, 6 + i % 3) for i in range(n)}


def noisy(truth: np.ndarray, share: float, identities: int, seed: int) -> np.ndarray:
    """The truth with a share of the pixels replaced by random identities."""
    rng = np.random.default_rng(seed)
    return np.where(rng.random(truth.shape) < share, rng.integers(0, identities, truth.shape), truth)


def strip(*frames: list[int]) -> np.ndarray:
    """A video of one-row images; each number stands for eight pixels, more than the small-mask filter drops."""
    return np.repeat(np.array(frames)[:, None, :], 8, axis=2)


def counts_of(prediction: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Contingency table (T, G, P) of one video."""
    return contingency(torch.from_numpy(prediction)[None], torch.from_numpy(truth)[None]).counts[0].numpy()


@pytest.fixture(scope="session")
def make() -> SimpleNamespace:
    """What tests draw their videos with."""
    return SimpleNamespace(some_videos=some_videos, noisy=noisy, strip=strip, counts_of=counts_of)


@pytest.fixture(scope="session")
def public() -> PublicVideos:
    return PublicVideos()
