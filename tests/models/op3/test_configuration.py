"""OP3's configuration files: they build, and a recipe's loss names the model's terms."""

from __future__ import annotations

from pathlib import Path

import pytest
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from apex_lab.base.errors import UserError
from apex_lab.config.building import build_model
from apex_lab.models.op3 import Op3
from tests.conftest import compose_job

CONF = Path(__file__).parents[3] / "conf"


def composed(*files: str) -> DictConfig:
    """Files merged in order, as Hydra does for global packages."""
    merged = OmegaConf.merge(*(OmegaConf.load(CONF / f"{name}.yaml") for name in files))
    assert isinstance(merged, DictConfig)
    return merged


@pytest.mark.parametrize(
    ("files", "lr"),
    [
        (["recipe/op3/paper"], 3e-4),
        (["recipe/op3/cpu"], 3e-3),  # Muon's
        (["recipe/op3/quickstart"], 3e-4),
        (["recipe/op3/smoke"], 3e-4),
        (["recipe/op3/paper", "experiment/op3_original"], 3e-4),
        (["recipe/op3/paper", "experiment/op3_curriculum_original"], 3e-4),
    ],
)
def test_recipes(files: list[str], lr: float) -> None:
    config = composed("model/op3", *files)
    model = instantiate(config.model)
    assert isinstance(model, Op3)
    assert model.input_size == (config.model.image_size,) * 2
    assert tuple(config.loss) == Op3.term_names
    assert config.loss.kl == model.beta
    assert set(config.schedule) == set(model.schedule_ranges)
    assert instantiate(config.optimizer, params=model.parameters()).param_groups[0]["lr"] == lr


def test_defaults_are_the_papers() -> None:
    """The constructor's defaults are what the model's file says."""
    model, default = instantiate(composed("model/op3").model), Op3()
    for name in ("input_size", "slots", "sigma", "beta", "loss_batch", "plan"):
        assert getattr(model, name) == getattr(default, name), name
    assert {n: p.shape for n, p in model.named_parameters()} == {n: p.shape for n, p in default.named_parameters()}


@pytest.mark.parametrize(
    ("name", "slots", "schedule", "frames", "epochs"),
    [("op3_original", 7, "single_step_physics", 2, 150), ("op3_curriculum_original", 4, "curriculum", 5, 300)],
)
def test_the_original_experiments(name: str, slots: int, schedule: str, frames: int, epochs: int) -> None:
    """op3.md section 6, column [O]; an epoch takes every disjoint clip of the data once."""
    config = compose_job("model=op3", "scale=paper", "data=sprites", f"+experiment={name}").config
    model = build_model(config)
    assert isinstance(model, Op3)
    assert (model.slots, model.plan.schedule, model.plan.first, model.plan.weighting) == (slots, schedule, 4, "linear")
    assert (model.loss_batch, config.clips.batch_size, config.clips.frames) == (None, 80, frames)
    clips = config.data["train"] * (config.data["frames"] // frames)
    assert config.trainer.max_steps == epochs * clips / 80
    if schedule == "curriculum":  # up to one more every 10 epochs after epoch 100
        node, epoch = config.schedule["predictions"], clips // 80
        assert (node["delay"], node["every"]) == (100 * epoch, 10 * epoch)
    else:  # T = 5 steps
        assert len(model.plan.training_steps(frames)) == 5


def test_a_curriculum_cannot_be_captured() -> None:
    words = ("model=op3", "scale=paper", "data=sprites", "trainer.cuda_graph=true")
    with pytest.raises(UserError, match=r"cuda_graph = true repeats one step, .* set trainer\.cuda_graph=false"):
        compose_job(*words, "+experiment=op3_curriculum_original")
    with pytest.raises(UserError, match="needs one CUDA device"):  # the other schedules are the same at every step
        compose_job(*words, "trainer=cpu", "+experiment=op3_original")
