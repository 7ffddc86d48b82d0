"""Every model in conf/model/, as its smoke recipe builds it, keeps the contract (tests/models/contract.py)."""

from __future__ import annotations

from functools import lru_cache

import pytest

from apex_lab.config.building import build_model
from tests.conftest import REPOSITORY, compose_job
from tests.models.contract import CHECKS, Case, Check, name_of

MODELS = sorted(path.stem for path in (REPOSITORY / "conf" / "model").glob("*.yaml"))

WITHOUT_GRADIENT = {
    # added to all queries, it adds the same number to a token's logits of all slots
    "slot_attention": frozenset({"grouping.norm_slots.bias"}),
    # a softmax over neighbours takes it out again
    "gswm": frozenset({"history.interaction.logit_net.last.bias"}),
    # biases of convolutions that batch normalisation takes out again
    "space": frozenset(
        f"background.{network}.0.bias"
        for network in (
            "component_decoder.first",
            *(f"component_decoder.others.{i}" for i in range(3)),
            *(f"{encoder}.convs.{i}" for encoder in ("component_encoder", "image_encoder") for i in range(4)),
        )
    ),
}
"""Model -> names of weights whose gradient is zero for a reason."""


SCHEDULES = {
    # objects live long enough for a gradient to pass through the recurrence of propagation
    "apex": {"carry": 1.0, "discover": 1.0},
    # the foreground takes part
    "gswm": {"background_only": 0.0, "fixed_alpha": 0.0},
}
"""Model -> scheduled values that the checks need."""


@lru_cache(maxsize=1)
def case(model: str) -> Case:
    config = compose_job(f"model={model}", "scale=smoke").config
    built = build_model(config)
    side = built.input_size[0] if built.input_size else int(config.data["image_size"])
    return Case(
        built,
        frames=5,
        side=side,
        schedule=SCHEDULES.get(model, {}),
        without_gradient=WITHOUT_GRADIENT.get(model, frozenset()),
    )


@pytest.mark.parametrize("check", CHECKS, ids=name_of)
@pytest.mark.parametrize("model", MODELS)
def test_contract(model: str, check: Check) -> None:
    check(case(model))
