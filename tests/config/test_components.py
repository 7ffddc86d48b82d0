from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, SupportsFloat, TypedDict

import pytest
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from apex_lab.base.errors import UserError
from apex_lab.config.components import build, check

HERE = "tests.config.test_components"


@dataclass(frozen=True)
class Part:
    size: Annotated[int, Field(ge=1)]
    kind: Literal["round", "square"] = "round"


class Whole:
    def __init__(
        self,
        part: Part,
        share: float = 0.5,
        pair: tuple[int, int] = (1, 2),
        parts: list[Part] | None = None,
        named: dict[str, float] | None = None,
        model_size: int = 3,
        maybe: Annotated[int, Field(gt=0)] | None = None,
    ) -> None:
        if part.size > 9:
            raise ValueError(f"part.size = {part.size} does not fit: at most 9")
        self.part, self.share, self.pair, self.parts = part, share, pair, parts


def with_extra(size: int, **options: Any) -> dict[str, Any]:
    return {"size": size, **options}


def node(**values: Any) -> dict[str, Any]:
    part = {"_target_": f"{HERE}.Part", "size": 2}
    return {"_target_": f"{HERE}.Whole", "part": part, **values}


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"share": 1},
        {"pair": [3, 4]},
        {"parts": [{"_target_": f"{HERE}.Part", "size": 1}]},
        {"named": {"a": 1.0}},
        {"model_size": 4},
        {"maybe": None},
    ],
)
def test_accepts_and_builds(values: dict[str, Any]) -> None:
    check(node(**values), "model")
    built = build(node(**values), "model")
    assert isinstance(built, Whole)
    assert built.part == Part(2)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"shar": 0.5}, r"^Unknown key model\.shar = 0\.5; did you mean 'share'\?$"),
        ({"share": "0.5"}, r"^model\.share = '0\.5' is wrong: input should be a valid number\.$"),
        ({"share": True}, r"^model\.share = true is wrong"),
        ({"share": float("nan")}, r"^model\.share = NaN is wrong: input should be a finite number\.$"),
        ({"pair": [1]}, r"^model\.pair\.1 is missing"),
        ({"pair": [1, 2.5]}, r"^model\.pair\.1 = 2\.5 is wrong"),
        ({"model_size": 4.5}, r"^model\.model_size = 4\.5 is wrong: input should be a valid integer"),
        ({"maybe": 0}, r"^model\.maybe = 0 is wrong: input should be greater than 0\.$"),
        ({"named": {"a": "x"}}, r"^model\.named\.a = 'x' is wrong: input should be a valid number\.$"),
        ({"part": {"_target_": f"{HERE}.Part", "size": 0}}, r"^model\.part\.size = 0 is wrong: .* equal to 1\.$"),
        ({"part": {"_target_": f"{HERE}.Part", "sise": 0}}, r"^Unknown key model\.part\.sise = 0; .*'size'\?$"),
        ({"part": {"_target_": f"{HERE}.Part"}}, r"^model\.part\.size is missing: give it a value\.$"),
        ({"part": {"_target_": f"{HERE}.Part", "size": 1, "kind": "flat"}}, r"kind = 'flat' is wrong: .*'round'"),
        ({"parts": [{"_target_": f"{HERE}.Part", "size": 0}]}, r"^model\.parts\[0\]\.size = 0 is wrong"),
        ({"part": {"_target_": "no.such.Thing"}}, r"^model\.part\._target_ = 'no\.such\.Thing' cannot be imported"),
        ({"part": {"_target_": f"{HERE}.HERE"}}, r"is not a class or function\.$"),
        ({"part": {"_target_": 3}}, r"^model\.part\._target_ = 3 is not the name of a class"),
        ({"part": 3}, r"^model\.part = 3 is wrong"),
        ({"part": node()}, r"^model\.part: .*Whole cannot stand here, where Part is asked for\.$"),
        ({"parts": node()["part"]}, r"^model\.parts: .*Part cannot stand here, where list or nothing is asked for\.$"),
        ({"named": node()["part"]}, r"^model\.named: .*Part cannot stand here, where dict or nothing is asked for\.$"),
    ],
)
def test_refuses_in_one_sentence(values: dict[str, Any], told: str) -> None:
    with pytest.raises(UserError, match=told) as refusal:
        check(node(**values), "model")
    assert "\n" not in str(refusal.value)


class Fields(TypedDict):
    size: int


class Loose:
    """Hints that no class tells."""

    def __init__(
        self,
        unhinted,  # type: ignore[no-untyped-def]
        anything: Any,
        maybe: Any | None,
        unknown: NoSuchName,  # type: ignore[name-defined]  # noqa: F821
        called: Callable[[int], int],
        several: Sequence[Part],
        array: Float[Tensor, "3"],
        typed: Fields,
        sized: SupportsFloat,
    ) -> None:
        self.given = (unhinted, anything, maybe, unknown, called, several, array, typed, sized)


def test_what_no_class_tells_takes_any_component() -> None:
    names = list(inspect.signature(Loose).parameters)
    loose = {"_target_": f"{HERE}.Loose", **{name: node()["part"] for name in names}}
    check(loose, "model")
    assert build(loose, "model").given == (Part(2),) * len(names)


def test_a_class_without_a_signature_is_refused() -> None:
    with pytest.raises(UserError, match=r"^model\._target_ cannot be used: no signature found"):
        check({"_target_": "builtins.dict"}, "model")


def test_a_constructor_s_own_check_is_told() -> None:
    whole = node(part={"_target_": f"{HERE}.Part", "size": 10})
    check(whole, "model")
    with pytest.raises(UserError, match=r"^model \(.*Whole\): part\.size = 10 does not fit: at most 9\.$"):
        build(whole, "model")


def test_supplied_parameters_are_not_for_the_configuration() -> None:
    adam = {"_target_": "torch.optim.Adam", "lr": 1e-3, "betas": [0.9, 0.99]}
    check(adam, "optimizer", supplied=["params"])
    with pytest.raises(UserError, match=r"Unknown key optimizer\.params"):
        check({**adam, "params": []}, "optimizer", supplied=["params"])
    with pytest.raises(UserError, match=r"^optimizer\.lr = 'abc' is wrong: input should be a valid number\.$"):
        check({**adam, "lr": "abc"}, "optimizer", supplied=["params"])


def test_further_keywords_pass_where_the_target_takes_them() -> None:
    free = {"_target_": f"{HERE}.with_extra", "size": 1, "colour": "red"}
    check(free, "data")
    assert build(free, "data") == {"size": 1, "colour": "red"}
    with pytest.raises(UserError, match=r"^data\.size = 'x' is wrong"):
        check({**free, "size": "x"}, "data")
