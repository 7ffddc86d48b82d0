"""The composed recipes of the paper's scale against the tables of scalor.md (sections 0, 5 to 13), by number.

The authors' code counts steps from 1 inside the model and from 0 for the temperature; ours counts from 0.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hydra import compose

from apex_lab.config import components
from apex_lab.config.composition import composing, plain
from apex_lab.models.scalor import AnchoredSize, FreeSize, Scalor
from apex_lab.models.scalor.latents import LOGIT_BOUND
from apex_lab.models.scalor.objective import REJECTED_PRIOR
from apex_lab.models.scalor.propagation import PRESENT_AT_FIRST, PRESENT_BY_PRIOR, WHERE_OFFSET
from apex_lab.models.scalor.windows import EDGE, SHIFT

PAPER = ("model=scalor", "scale=paper", "data=p2d")
ORIGINAL = ("scale=paper", "data=p2d", "+experiment=scalor_original")


def composed(*words: str) -> dict[str, Any]:
    with composing(words):
        return plain(compose("train", overrides=list(words)))


@pytest.mark.parametrize(
    ("words", "batch", "frames", "weight", "slots"),
    [
        (PAPER, 4, None, 1 / 20, None),
        (ORIGINAL, 20, 10, 1 / 10, 128),
        (("model=scalor", "scale=paper", "data=sketchy"), 4, None, 1 / 10, None),
        ((*PAPER, "data.frames=10"), 4, None, 1 / 10, None),
        ((*PAPER, "clips.frames=5"), 4, 5, 1 / 5, None),
    ],
)
def test_training(words: tuple[str, ...], batch: int, frames: int | None, weight: float, slots: int | None) -> None:
    """The published objective is the mean over time: 1 / frames of a clip, whatever its length."""
    config = composed(*words)
    assert (config["clips"]["batch_size"], config["clips"]["frames"]) == (batch, frames)
    assert config["trainer"]["max_steps"] == 40_000
    assert config["trainer"]["gradient_clip_norm"] == 1.0
    assert config["optimizer"] == {"_target_": "torch.optim.RMSprop", "lr": 4e-5}
    defaults = torch.optim.RMSprop([torch.nn.Parameter(torch.zeros(1))]).defaults
    assert (defaults["alpha"], defaults["eps"], defaults["momentum"], defaults["centered"]) == (0.99, 1e-8, 0, False)
    assert config["lr_scale"] == 1.0
    assert config["loss"] == dict.fromkeys(Scalor.term_names, weight)
    assert config["model"]["evaluation_objects"] == slots


@pytest.mark.parametrize("words", [PAPER, ORIGINAL])
def test_schedules(words: tuple[str, ...]) -> None:
    nodes = composed(*words)["schedule"]
    schedule = {name: components.build(node, f"schedule.{name}") for name, node in nodes.items()}
    assert set(schedule) == set(Scalor.schedule_ranges)
    temperature = [schedule["temperature"](step) for step in (0, 10_000, 20_000, 40_000)]
    assert temperature == pytest.approx([1.0, 0.5**0.5, 0.5, 0.5])
    prior = [schedule["discovery_presence"](published - 1) for published in (1, 250, 500, 40_000)]
    assert prior == pytest.approx([0.1 - 0.099 / 500, 0.0505, 0.001, 0.001])
    assert [schedule["slot_gradient"](published - 1) for published in (1, 29_999, 30_000, 40_000)] == [0, 0, 1, 1]
    assert [schedule["alpha_curriculum"](step) for step in (0, 199, 40_000)] == [0, 0, 0]


def test_model() -> None:
    config = composed(*PAPER)["model"]
    sizes = ("image_size", "grid", "glimpse_size", "what", "background", "max_objects")
    assert [config[key] for key in sizes] == [128, 8, 64, 64, 10, 45]
    assert (config["sigma"], config["track"], config["stop"]) == (0.1, 0.7, 0.6)
    assert components.build(config["size"], "model.size") == FreeSize(0.03, 0.0)
    assert composed(*ORIGINAL)["model"]["size"] is None
    rule = AnchoredSize()
    assert (rule.size, rule.size_range, rule.ratio, rule.ratio_range) == (0.1, 0.03, 2.5, 0.5)


def test_constants() -> None:
    assert (LOGIT_BOUND, PRESENT_AT_FIRST, PRESENT_BY_PRIOR, WHERE_OFFSET) == (8.8, 2.0, 5.0, -2.0)
    assert (SHIFT, EDGE, REJECTED_PRIOR) == (0.2, 1.05, 1e-8)
