"""Configurations of SPACE: complete, and with the published schedules (space.md sections 8 and 9)."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from apex_lab.config.building import build_model
from apex_lab.models.space import Space
from apex_lab.runs.checkpoints import inference_part
from apex_lab.training.schedules import Staircase
from tests.conftest import compose_job
from tests.models.space.common import published

CONF = Path(__file__).parents[3] / "conf"


def recipe(scale: str) -> dict[str, Any]:
    return yaml.safe_load((CONF / "recipe" / "space" / f"{scale}.yaml").read_text())


def linear(node: dict[str, Any], step: int) -> float:
    """Value of a `Linear` node, clamped at both ends."""
    assert node["_target_"].endswith(".Linear")
    progress = (step - node.get("delay", 0)) / node["steps"]
    return node["start"] + (node["end"] - node["start"]) * min(1.0, max(0.0, progress))


def test_the_model_file_has_the_published_defaults() -> None:
    node = yaml.safe_load((CONF / "model" / "space.yaml").read_text())["model"]
    assert node.pop("_target_") == "apex_lab.models.space.Space"
    assert node.pop("image_size") == "${data.image_size}"
    arguments = inspect.signature(Space).parameters
    assert node == {name: p.default for name, p in arguments.items() if name != "image_size"}


@pytest.mark.parametrize("scale", ["paper", "cpu", "quickstart", "smoke"])
def test_recipes_are_complete(scale: str) -> None:
    found = recipe(scale)
    found.pop("defaults", None)  # what depends on the data
    assert set(found) == {"model", "trainer", "clips", "optimizer", "lr_scale", "schedule", "loss"}
    assert set(found["schedule"]) == set(Space.schedule_ranges)
    assert set(found["loss"]) == set(Space.term_names)
    assert set(found["model"]) <= set(inspect.signature(Space).parameters)
    assert found["clips"]["frames"] == 1
    groups = found["optimizer"]["groups"].values()
    prefixes = tuple(group["parameters"] for group in groups)
    names = [name for name, _ in Space(**{**found["model"], "image_size": 32, "grid": 4}).named_parameters()]
    assert all(name.startswith(prefixes) for name in names)


def test_paper_schedules_are_the_published_ones() -> None:
    schedule, arrays = recipe("paper")["schedule"], published()
    pairs = {"presence_prior": "anneal_z_pres", "scale_prior": "anneal_z_scale", "temperature": "anneal_tau"}
    for name, key in pairs.items():
        values = [linear(schedule[name], step) for step in arrays["anneal_steps"].tolist()]
        torch.testing.assert_close(torch.tensor(values), arrays[key], atol=1e-5, rtol=0)


def test_evaluation_uses_the_values_that_the_schedules_end_with() -> None:
    """space.md sections 8 and 10; so does a checkpoint from the midst of training."""
    config = compose_job("model=space", "scale=smoke").config
    found = inference_part(config, build_model(config), step=1)["schedule"]
    ends = {"temperature": 0.5, "presence_prior": 0.01, "scale_prior": -2.0, "fix_alpha": 0.0, "fixed_alpha": 0.1}
    assert found == pytest.approx(ends)


@pytest.mark.parametrize("steps", [2, 3, 4000])
def test_a_warm_up_of_n_steps_as_the_recipes_say(steps: int) -> None:
    """space.md section 6: alpha is fixed while 0 < step < N."""
    schedule = Staircase(values=[0, 1, 0], milestones=[0, steps - 1])
    assert [step for step in range(steps + 5) if schedule(step) == 1] == list(range(1, steps))


def test_the_original_experiment() -> None:
    """space.md section 9, column 3d_room_small."""
    config = compose_job("model=space", "scale=paper", "data=sprites", "+experiment=space_original").config
    model = config.model
    assert (model["image_size"], model["grid"], model["components"], model["glimpse_size"]) == (128, 8, 5, 32)
    assert (model["sigma_fg"], model["sigma_bg"], model["scale_std"]) == (0.15, 0.15, 0.1)
    assert (config.trainer.max_steps, config.clips.batch_size, config.trainer.gradient_clip_norm) == (160_000, 12, 1.0)
    assert config.schedule == recipe("paper")["schedule"]
    assert config.optimizer == recipe("paper")["optimizer"]
