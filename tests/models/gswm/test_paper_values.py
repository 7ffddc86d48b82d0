"""The composed recipes of the paper's scale against the table of gswm.md, section 11, column "obj3d", by number."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hydra import compose

from apex_lab.config import components
from apex_lab.config.composition import composing, plain
from apex_lab.models.gswm import Gswm

PAPER = ("model=gswm", "scale=paper", "data=p2d")
ORIGINAL = ("scale=paper", "data=p2d", "+experiment=gswm_original")


def composed(*words: str) -> dict[str, Any]:
    with composing(words):
        return plain(compose("train", overrides=list(words)))


@pytest.mark.parametrize(("words", "steps", "batch", "side"), [(PAPER, 50_000, 4, 128), (ORIGINAL, 1_000_000, 16, 64)])
def test_training(words: tuple[str, ...], steps: int, batch: int, side: int) -> None:
    config = composed(*words)
    assert (config["trainer"]["max_steps"], config["clips"]["batch_size"]) == (steps, batch)
    assert config["data"]["image_size"] == config["model"]["image_size"] == side
    assert config["optimizer"] == {"_target_": "torch.optim.Adam", "lr": 1e-4}
    defaults = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))]).defaults
    assert (defaults["betas"], defaults["eps"], defaults["weight_decay"]) == ((0.9, 0.999), 1e-8, 0)
    assert (config["lr_scale"], config["trainer"]["gradient_clip_norm"]) == (1.0, 1.0)
    assert config["loss"] == dict.fromkeys(Gswm.term_names, 1.0)  # AUX_PRES_KL is on


@pytest.mark.parametrize(
    ("words", "pace", "longest"),
    [
        (PAPER, 1_000, 20),
        (ORIGINAL, 10_000, 20),
        (("model=gswm", "scale=paper", "data=sketchy"), 2_000, 10),
        (("scale=paper", "data=sketchy", "+experiment=gswm_original"), 10_000, 10),
    ],
)
def test_clips_grow_by_two_frames(words: tuple[str, ...], pace: int, longest: int) -> None:
    """A milestone is the last step of its stair; whole videos are the end."""
    frames = components.build(composed(*words)["clips"]["frames"], "clips.frames")
    for stair in range(longest // 2):
        assert frames(stair * pace + 1) == frames((stair + 1) * pace) == 2 * (stair + 1)
    assert frames(0) == 2
    assert frames(10**6) == longest


@pytest.mark.parametrize("words", [PAPER, ORIGINAL])
def test_schedules(words: tuple[str, ...]) -> None:
    nodes = composed(*words)["schedule"]
    schedule = {name: components.build(node, f"schedule.{name}") for name, node in nodes.items()}
    assert set(schedule) == set(Gswm.schedule_ranges) - set(Gswm.optional_schedules)
    steps = (0, 5_000, 10_000, 50_000, 1_000_000)
    assert [schedule["temperature"](step) for step in steps] == [1.0] * 5
    assert [schedule["presence_prior"](step) for step in steps] == [1e-10] * 5
    assert [schedule["scale_mean"](step) for step in steps] == pytest.approx([-1.5, -1.625, -1.75, -1.75, -1.75])
    assert [schedule["sigma"](step) for step in steps] == [0.1] * 5
    assert [schedule["background_only"](step) for step in steps] == [0.0] * 5  # BG_ONLY_STEP is 0


@pytest.mark.parametrize("words", [PAPER, ORIGINAL])
def test_model(words: tuple[str, ...]) -> None:
    model = composed(*words)["model"]
    assert model["image_encoder"]["grid"] == 4
    assert (model["max_objects"], model["glimpse_size"]) == (10, 16)
    assert (model["what"], model["dyna"], model["background"]["latent"]) == (64, 128, 128)
    assert (model["scale_std"], model["map_sigma"], model["environment_margin"]) == (0.1, 0.1, 0.25)
    assert (model["rejection_iou"], model["discovery_dropout"], model["environment"]) == (0.8, 0.5, "attention")
    motion = {"grow_min": 0.1, "grow_max": 0.3, "scale": 0.3, "shift": 0.6, "depth": 1.0, "what": 0.2}
    assert {key: model["motion"][key] for key in motion} == motion
    assert model["motion"]["bounded"] is False
