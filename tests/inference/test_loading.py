"""A trained model with other values of what no weight depends on."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from apex_lab.base.errors import UserError
from apex_lab.inference.loading import trained_model
from apex_lab.models.op3 import Op3
from apex_lab.models.slot_attention import SlotAttention
from apex_lab.scene import Context


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


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"variant": "small"}, "model.variant = 'small' would not fit the trained weights: only slots, iterations"),
        ({"slotz": 7}, "model.slotz = 7 would not fit the trained weights: only slots, iterations can be given here."),
        ({"slots": 0}, "model.slots"),
        ({"slots": "many"}, "model.slots"),
    ],
)
def test_other_changes_are_refused(changes: dict[str, Any], told: str) -> None:
    sizes = {"image_size": 16, "features": 4, "slot_size": 6, "hidden": 8}
    with pytest.raises(UserError, match=told):
        trained_model(inference(SlotAttention(**sizes), **sizes), changes)
