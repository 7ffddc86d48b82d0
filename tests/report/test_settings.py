"""Configurations beside each other."""

from __future__ import annotations

from apex_lab.report.contents import Settings, ranges
from apex_lab.report.settings import Setting, compared, flat


def test_keys_are_those_of_the_command_line() -> None:
    raw = {
        "seed": 3,
        "paths": {"data": "x"},
        "model": {"a": {"b": 1e-3, "c": None}, "on": True},
        "callbacks": {},
        "l": [1, 2],
    }
    assert flat(raw) == {
        "model.a.b": "0.001",
        "model.a.c": "null",
        "model.on": "true",
        "callbacks": "{}",
        "l": "[1, 2]",
    }


def test_differences_go_both_ways() -> None:
    lines = compared({"a": "1", "b": "2"}, {"b": "3", "c": "4", "a": "1"})
    assert lines == [Setting("a", "1", "1", False), Setting("b", "2", "3", True), Setting("c", None, "4", True)]
    assert Settings("x", "y", lines).summary == "1 key differs, 1 is in one of the two"
    assert Settings("x", None, lines).different == []
    assert Settings("x", "y", lines[:1]).summary == "no difference"


def test_seeds_are_told_in_few_characters() -> None:
    assert ranges([3, 0, 1, 2, 7]) == "0–3, 7"
    assert ranges([]) == ""
