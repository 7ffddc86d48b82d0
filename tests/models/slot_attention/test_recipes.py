"""The shipped configuration builds the model that it says, and each recipe fits it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from apex_lab.config.components import build, check
from apex_lab.models.slot_attention import SlotAttention
from apex_lab.training import schedules as training_schedules_slot_attention

CONF = Path(__file__).parents[3] / "conf"
SIDES = {"paper": 128, "cpu": 64, "quickstart": 64, "smoke": 32}
INPUTS = {**SIDES, "cpu": 32}
"""What the model sees: at scale=cpu a recipe of its own shrinks the images."""


def composed(scale: str, *words: str) -> Any:
    chosen = [
        "+model=slot_attention",
        f"+recipe=slot_attention/{scale}",
        "+paths=default",
        "+data=sprites",
        f"data.image_size={SIDES[scale]}",
        *words,
    ]
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        return OmegaConf.to_container(compose(overrides=chosen), resolve=True)


@pytest.mark.parametrize("scale", SIDES)
def test_recipe(scale: str) -> None:
    config = composed(scale)
    check(config["model"], "model")
    model = build(config["model"], "model")
    assert isinstance(model, SlotAttention)
    assert model.input_size == (INPUTS[scale], INPUTS[scale])
    assert config["loss"].keys() == set(model.term_names)
    assert config["schedule"].keys() == set(model.schedule_ranges)
    assert config["clips"]["frames"] == 1
    lr_scale = {**config["lr_scale"]}
    kind = getattr(training_schedules_slot_attention, lr_scale.pop("_target_").split(".")[-1])
    assert 0.8 < kind(**lr_scale)(lr_scale["warmup"]) <= 1  # most of the rate is left after the warm-up


def test_the_paper_s_recipe_is_the_released_model() -> None:
    config = composed("paper")
    assert sum(p.numel() for p in build(config["model"], "model").parameters()) == 890_308
    assert config["optimizer"] == {"_target_": "torch.optim.Adam", "lr": 4e-4}
    assert (config["lr_scale"]["warmup"], config["lr_scale"]["half_life"]) == (10_000, 100_000)
    assert config["trainer"]["max_steps"] == 400_000


def test_the_original_experiment() -> None:
    config = composed("paper", "+experiment=slot_attention_original")
    assert (config["model"]["slots"], config["clips"]["batch_size"], config["trainer"]["max_steps"]) == (7, 64, 500_000)
    model = build(config["model"], "model")
    assert (model.iterations, model.input_size) == (3, (128, 128))
    assert sum(p.numel() for p in model.parameters()) == 890_308
    assert config["optimizer"] == {"_target_": "torch.optim.Adam", "lr": 4e-4}
    assert (config["lr_scale"]["warmup"], config["lr_scale"]["half_life"]) == (10_000, 100_000)
    assert config["trainer"]["gradient_clip_norm"] is None
