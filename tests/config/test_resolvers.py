"""What configuration files can compute, by number."""

from __future__ import annotations

from typing import Any

import pytest
from omegaconf import OmegaConf

from apex_lab.config import resolvers
from tests.conftest import compose_job


@pytest.fixture(autouse=True)
def _registered() -> None:
    resolvers.register()


@pytest.mark.parametrize(
    ("clips", "data", "want"),
    [
        ({"frames": None}, {"frames": 8}, 1 / 8),
        ({"frames": 5}, {"frames": 8}, 1 / 5),
        ({"frames": {"values": [1, 2], "milestones": [3]}}, {"frames": 8}, 1 / 8),
        ({"frames": None}, {}, 1 / 20),
        ({"frames": 0}, {"frames": "many"}, 1 / 20),
    ],
)
def test_per_frame(clips: dict[str, Any], data: dict[str, Any], want: float) -> None:
    config = OmegaConf.create({"clips": clips, "data": data, "loss": {"nll": "${per_frame:20}"}})
    assert config.loss.nll == want


@pytest.mark.parametrize(
    ("frames", "values", "milestones"),
    [
        (None, [2, 4, 6], [10, 20]),
        (6, [2, 4, 6], [10, 20]),
        (9, [2, 4, 6], [10, 20]),
        (5, [2, 4, 5], [10, 20]),
        (4, [2, 4], [10]),
        (1, [1], []),
    ],
)
def test_stairs(frames: int | None, values: list[int], milestones: list[int]) -> None:
    config = OmegaConf.create({"data": {"frames": frames}, "clips": {"frames": "${stairs:[2,4,6],[10,20]}"}})
    found = OmegaConf.to_container(config, resolve=True)["clips"]["frames"]  # type: ignore[index, call-overload]
    assert found == {"_target_": "apex_lab.training.schedules.Staircase", "values": values, "milestones": milestones}


def test_original_settings_on_sketchy() -> None:
    job = compose_job("model=gswm", "data=sketchy", "scale=paper", "+experiment=gswm_original")
    assert job.config.clips.frames["values"][-1] == job.config.data["frames"] == 10
