"""OP3's configuration files: they build, and a recipe's loss names the model's terms."""

from __future__ import annotations

from pathlib import Path

import pytest
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from apex_lab.models.op3 import Op3

CONF = Path(__file__).parents[3] / "conf"


def composed(*files: str) -> DictConfig:
    """Files merged in order, as Hydra does for global packages."""
    merged = OmegaConf.merge(*(OmegaConf.load(CONF / f"{name}.yaml") for name in files))
    assert isinstance(merged, DictConfig)
    return merged


@pytest.mark.parametrize("recipe", ["paper", "cpu", "quickstart", "smoke"])
@pytest.mark.parametrize("experiment", [[], ["experiment/op3_original"]])
def test_recipes(recipe: str, experiment: list[str]) -> None:
    config = composed("model/op3", f"recipe/op3/{recipe}", *experiment)
    model = instantiate(config.model)
    assert isinstance(model, Op3)
    assert model.input_size == (config.model.image_size,) * 2
    assert tuple(config.loss) == Op3.term_names
    assert config.loss.kl == model.beta
    assert set(config.schedule) == set(Op3.schedule_ranges)
    assert instantiate(config.optimizer, params=model.parameters()).param_groups[0]["lr"] == 3e-4


def test_defaults_are_the_papers() -> None:
    """The constructor's defaults are what the model's file says."""
    model, default = instantiate(composed("model/op3").model), Op3()
    for name in ("input_size", "slots", "sigma", "beta", "loss_batch", "plan"):
        assert getattr(model, name) == getattr(default, name), name
    assert {n: p.shape for n, p in model.named_parameters()} == {n: p.shape for n, p in default.named_parameters()}
