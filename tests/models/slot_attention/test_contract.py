"""The contract of all models, of each variant."""

from __future__ import annotations

from functools import lru_cache

import pytest

from apex_lab.models.slot_attention import SlotAttention
from tests.models.contract import CHECKS, Case, Check, name_of


@lru_cache
def case(variant: str) -> Case:
    model = SlotAttention(image_size=16, variant=variant, features=8, slot_size=12, hidden=16)
    # added to all queries, it adds the same number to a token's logits of all slots
    return Case(model, frames=3, side=16, without_gradient=frozenset({"grouping.norm_slots.bias"}))


@pytest.mark.parametrize("check", CHECKS, ids=name_of)
@pytest.mark.parametrize("variant", ["released", "strided", "small"])
def test_contract(check: Check, variant: str) -> None:
    check(case(variant))
