"""Every recipe of SCALOR builds, and the published values are in the ones that claim them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from apex_lab.config import components
from apex_lab.models.scalor import AnchoredSize, FreeSize, Scalor

CONF = Path(__file__).parents[3] / "conf"
SIZES = {"paper": 128, "cpu": 64, "quickstart": 64, "smoke": 32}


def merged(scale: str, *further: str) -> dict[str, Any]:
    files = ["model/scalor.yaml", f"recipe/scalor/{scale}.yaml", *further]
    config = OmegaConf.merge({"data": {"image_size": SIZES[scale]}}, *(OmegaConf.load(CONF / file) for file in files))
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    return plain  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("scale", "further", "size"),
    [
        ("paper", [], FreeSize),
        ("cpu", ["recipe/scalor/cpu_for/p2d.yaml"], AnchoredSize),
        ("cpu", ["recipe/scalor/cpu_for/sprites.yaml"], AnchoredSize),
        ("quickstart", [], FreeSize),
        ("smoke", [], FreeSize),
    ],
)
def test_builds(scale: str, further: list[str], size: type) -> None:
    config = merged(scale, *further)
    components.check(config["model"], "model")
    model = components.build(config["model"], "model")
    assert isinstance(model, Scalor)
    assert isinstance(model.objects.discovery.size, size)
    assert set(config["loss"]) == set(Scalor.term_names)
    assert set(config["schedule"]) == set(Scalor.schedule_ranges)


def test_paper() -> None:
    config = merged("paper")
    assert config["clips"]["batch_size"] == 4
    assert config["trainer"]["max_steps"] == 40_000
    assert config["optimizer"] == {"_target_": "torch.optim.RMSprop", "lr": 4e-5}
    assert set(config["loss"].values()) == {1 / 20}


def test_original_settings() -> None:
    config = merged("paper", "experiment/scalor_original.yaml")
    components.check(config["model"], "model")
    model = components.build(config["model"], "model")
    assert model.objects.discovery.size == AnchoredSize(0.1, 0.03, 2.5, 0.5)
    assert config["clips"] == {"batch_size": 20, "frames": 10}
    assert set(config["loss"].values()) == {1 / 10}
