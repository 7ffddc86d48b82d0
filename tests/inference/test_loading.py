"""A trained model with other values of what no weight depends on."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from apex_lab.base.errors import UserError
from apex_lab.config.shipped import weights
from apex_lab.inference.loading import trained_model
from apex_lab.models.apex import Apex
from apex_lab.models.op3 import Op3
from apex_lab.models.slot_attention import SlotAttention
from apex_lab.runs import checkpoints
from apex_lab.scene import Context, schedule_at


def inference(model: torch.nn.Module, **arguments: Any) -> dict[str, Any]:
    name = type(model).__name__
    module = {"SlotAttention": "slot_attention", "Op3": "op3"}[name]
    return {"model": {"_target_": f"apex_lab.models.{module}.{name}", **arguments}, "weights": model.state_dict()}


def test_slots_and_iterations_of_slot_attention() -> None:
    """slot_attention.md section 6: call-time options."""
    sizes = {"image_size": 16, "features": 4, "slot_size": 6, "hidden": 8}
    trained = inference(SlotAttention(**sizes), **sizes)
    model = trained_model(trained, {"slots": 7, "iterations": 5})
    assert isinstance(model, SlotAttention)
    assert (model.slots, model.iterations) == (7, 5)
    assert model(torch.rand(1, 2, 3, 16, 16), Context()).masks.shape == (1, 2, 7, 16, 16)
    for name, weight in trained["weights"].items():
        assert torch.equal(model.state_dict()[name], weight)
    assert trained["model"].keys() == {"_target_", *sizes}  # what is stored stays as it is


def test_slots_and_refinements_of_op3() -> None:
    sizes = {"image_size": 8, "stochastic": 4, "deterministic": 4, "hidden": 8}
    model = trained_model(inference(Op3(**sizes), **sizes), {"slots": 8, "refinements": 1, "first_refinements": 5})
    assert isinstance(model, Op3)
    assert (model.slots, model.plan.first, model.plan.later) == (8, 5, 1)


def blocks_seen(**changes: Any) -> torch.Tensor:
    """Labels (T, H, W) that the shipped weights give to nine grey blocks on the background that they remember."""
    model = trained_model(checkpoints.load(weights("apex-p2d-cpu"))["inference"], changes).eval()
    assert isinstance(model, Apex)
    assert model.background.bias_image is not None
    for name, value in changes.items():
        assert getattr(model, name) == value
    video = torch.sigmoid(model.background.bias_image.detach())[None, None].repeat(1, 3, 1, 1, 1)
    for y in (6, 26, 46):
        for x in (6, 26, 46):
            video[..., y : y + 8, x : x + 8] = 0.95
    with torch.no_grad():
        return model(video, Context(schedule_at(dict.fromkeys(model.schedule_ranges, 1.0)))).segmentation()[0]


def test_slots_of_apex() -> None:
    """Fewer slots than objects keep as many apart as there are; more than objects change nothing."""
    usual = blocks_seen()
    assert len(usual[0].unique()) > 3
    assert len(blocks_seen(max_objects=2)[0].unique()) == 3  # and the background
    assert len(blocks_seen(max_objects=1, render_top=1, keep_threshold=0.3)[0].unique()) == 2
    assert torch.equal(blocks_seen(max_objects=12), usual)
    assert torch.equal(blocks_seen(max_objects=12, render_top=12, keep_threshold=0.6), usual)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"variant": "small"}, "model.variant = 'small' cannot be changed for trained weights: only slots, iterations"),
        ({"slotz": 7}, "model.slotz = 7 cannot be changed for trained weights: only slots, iterations can."),
        ({"slots": 0}, "model.slots"),
        ({"slots": "many"}, "model.slots"),
    ],
)
def test_other_changes_are_refused(changes: dict[str, Any], told: str) -> None:
    sizes = {"image_size": 16, "features": 4, "slot_size": 6, "hidden": 8}
    with pytest.raises(UserError, match=told):
        trained_model(inference(SlotAttention(**sizes), **sizes), changes)
