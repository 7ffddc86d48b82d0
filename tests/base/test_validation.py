"""Values in the words of whoever wrote them."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Annotated, Any

import pytest
from pydantic import BaseModel, Field

from apex_lab.base.errors import UserError
from apex_lab.base.validation import PathText, path_argument, refuse_large_numbers, short, to_open, validate


class Asked(BaseModel):
    clips: Annotated[int, Field(ge=1)] | Annotated[list[int], Field(min_length=1)] = 1
    folder: PathText | list[PathText] | None = None
    rate: float = 1.0


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"clips": []}, "clips = [] is wrong: list should have at least 1 item after validation, not 0."),
        ({"clips": 0}, "clips = 0 is wrong: input should be greater than or equal to 1."),
        ({"clips": "x"}, "clips = 'x' is wrong: input should be a valid integer, unable to parse string as an integer"),
        ({"folder": ""}, "folder = '' is wrong: it is empty, as an unset variable is: give a path."),
        ({"folder": ["a", " "]}, "folder = ['a', ' '] is wrong: it is empty, as an unset variable is: give a path."),
        ({"folder": 3}, "folder = 3 is wrong: input should be a valid string, or input should be a valid "),
        ({"rate": 1e39}, "rate = 1e+39 is wrong: no number in single precision is above 3.40282e+38 in size."),
        (
            {"clips": [1, {"x": -(2**63) - 1}]},
            "clips[1].x = a whole number of 64 bits is wrong: give one of 64 bits at ",
        ),
    ],
)
def test_the_first_fault_in_one_sentence(values: dict[str, Any], told: str) -> None:
    with pytest.raises(UserError) as caught:
        validate(Asked, values, "")
    assert str(caught.value).startswith(told)
    with pytest.raises(UserError) as caught:
        validate(Asked, values, "part", {"clips": "shown", "folder": "shown", "rate": "shown"})
    assert str(caught.value).startswith("part.shown")


def test_numbers_that_arrays_can_hold() -> None:
    refuse_large_numbers(
        {"a": [2**63 - 1, -(2**63)], "b": 3.4e38, "c": None, "d": True, "e": float("inf"), "f": "1e308"}
    )


@pytest.mark.parametrize("path", ["", "  ", "x" * 5000, "a\0b"])
@pytest.mark.parametrize(
    ("read", "kind"),
    [(lambda path: to_open("folder", path), UserError), (path_argument, argparse.ArgumentTypeError)],
)
def test_paths_that_cannot_be(path: str, read: Callable[[str], object], kind: type[Exception]) -> None:
    with pytest.raises(kind, match=r"it is empty, as an unset variable is|no path can be so \("):
        read(path)


def test_the_middle_of_a_long_text_is_left_out() -> None:
    assert short("abc", 3) == "abc"
    assert short("a" * 50 + "b" * 50, 20) == "aaaaaaaaaa ... bbbbbbbbbb"
