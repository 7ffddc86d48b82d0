"""Swept words: what Optuna draws from, which values are written, what is refused."""

from __future__ import annotations

import optuna
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from apex_lab.base.errors import UserError
from apex_lab.tuning.space import read


@pytest.mark.parametrize(
    ("text", "distribution", "samples"),
    [
        ("interval(1,8)", FloatDistribution(1.0, 8.0), [1.0, 8.0, 4.5]),
        ("tag(log,interval(1e-4,1e-2))", FloatDistribution(1e-4, 1e-2, log=True), [1e-4, 1e-2, pytest.approx(1e-3)]),
        ("int(interval(1,8))", IntDistribution(1, 8), [1, 8, 4]),
        ("tag(log,int(interval(1,16)))", IntDistribution(1, 16, log=True), [1, 16, 4]),
        ("range(2,9,2)", IntDistribution(2, 8, step=2), [2, 8, 4]),
        ("range(9,2,-2)", IntDistribution(3, 9, step=2), [3, 9, 5]),
        ("tag(log,range(1,9))", IntDistribution(1, 8, log=True), [1, 8, 2]),
        ("range(0.5,2.0,0.5)", FloatDistribution(0.5, 1.5, step=0.5), [0.5, 1.5, 1.0]),
        ("float(range(1,4))", FloatDistribution(1.0, 3.0, step=1.0), [1.0, 3.0, 2.0]),
        ("choice(4,8)", CategoricalDistribution([4, 8]), [4, 8]),
        ("4,8", CategoricalDistribution([4, 8]), [4, 8]),
        ("choice(true,'x y',1.5)", CategoricalDistribution([True, "x y", 1.5]), [True, "x y", 1.5]),
        ("choice([1,2],[3])", CategoricalDistribution(["[1,2]", "[3]"]), ["[1,2]", "[3]"]),
    ],
)
def test_what_is_drawn_from(text: str, distribution: object, samples: list[object]) -> None:
    fixed, (parameter,) = read([f"a.b={text}"])
    assert fixed == []
    assert parameter.distribution == distribution
    assert parameter.samples() == samples
    assert [type(value) for value in parameter.samples()] == [
        type(value) if isinstance(value, (bool, int, float, str)) else float for value in samples
    ]


@pytest.mark.parametrize(
    ("word", "value", "set_to"),
    [
        ("a=interval(0,1)", 1e-05, 1e-05),
        ("a=interval(0,1)", 0.1 + 0.2, 0.1 + 0.2),
        ("++a.b=range(1,4)", 3, 3),
        ("+a=choice(true,false)", True, True),
        ("a=choice('x y',z)", "x y", "x y"),
        ("a=choice('a,b=c',z)", "a,b=c", "a,b=c"),
        ("a=choice([1,2],[3])", "[1,2]", [1, 2]),
        ("a=choice(1,1.0)", 1.0, 1.0),
    ],
)
def test_what_a_trial_writes(word: str, value: str | int | float | bool, set_to: object) -> None:
    """The word of a trial, read again, sets the value that was drawn, in the way the sweep was written."""
    _, (parameter,) = read([word])
    written = OverridesParser.create().parse_override(parameter.word(value))
    assert (written.value(), type(written.value())) == (set_to, type(set_to))
    assert written.get_key_element() == word.partition("=")[0]


def test_draws_stay_inside() -> None:
    _, parameters = read(["a=range(2,9,2)", "b=tag(log,interval(1e-4,1e-2))", "c=choice(x,y)", "d=int(interval(3,4))"])
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    drawn = [[p.draw(trial) for p in parameters] for trial in (study.ask() for _ in range(40))]
    assert {row[0] for row in drawn} == {2, 4, 6, 8}
    assert all(1e-4 <= row[1] <= 1e-2 for row in drawn)
    assert sum(row[1] < 1e-3 for row in drawn) in range(10, 31)  # half of them, in the logarithm
    assert {row[2] for row in drawn} == {"x", "y"}
    assert {row[3] for row in drawn} == {3, 4}


def test_what_a_span_holds() -> None:
    _, (span, steps, whole, words) = read(
        ["a=interval(0.1,1)", "b=range(0.1,0.9,0.3)", "c=range(1,4)", "d=choice(1,true,x)"]
    )
    assert [span.holds(v) for v in (0.1, 1, 1.1, True, None, "0.5", {})] == [True, True, *[False] * 5]
    assert [steps.holds(v) for v in (0.1, 0.4, 0.7, 0.5, 1.0)] == [True, True, True, False, False]
    assert [whole.holds(v) for v in (1, 3, 4, 2.0)] == [True, True, False, False]
    assert [words.holds(v) for v in (1, True, "x", 1.0, False)] == [True, True, True, False, False]


def test_the_last_word_for_a_key_stays() -> None:
    fixed, parameters = read(["a=1", "b=interval(0,1)", "c=choice(1,2)", "b=2", "~d", "a=3", "c=choice(5,6)"])
    assert fixed == ["b=2", "~d", "a=3"]
    assert [p.text for p in parameters] == ["choice(5,6)"]


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("a=glob(*)", "glob chooses files by a pattern"),
        ("a=shuffle(1,2)", "shuffle has no meaning"),
        ("a=shuffle(range(1,4))", "shuffle has no meaning"),
        ("a=tag(logg,interval(1,2))", "tag 'logg' is unknown"),
        ("a=tag(log,choice(1,2))", "a choice takes no tag"),
        ("a=tag(log,interval(0,1))", "needs numbers above 0"),
        ("a=tag(log,range(1,9,2))", "with step 1"),
        ("a=interval(2,1)", "the first number must be below the second"),
        ("a=interval(1,1)", "the first number must be below the second"),
        ("a=interval(1,inf)", "both finite"),
        ("a=range(4,4)", "this range is empty"),
        ("a=range(1,4,0)", "step of a range is not 0"),
        ("a=choice(1,1)", "name each choice once"),
        ("model/apex/likelihood@x=choice(mixture,gaussian)", "no group with a package"),
        ("a", "cannot be read as key=value"),
    ],
)
def test_refused_words(word: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        read([word])
