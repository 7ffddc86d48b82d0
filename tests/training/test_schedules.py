from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apex_lab.training.schedules import Constant, Cosine, Curriculum, Exponential, Linear, Piecewise, Schedule


def test_constant() -> None:
    assert [Constant(0.5)(step) for step in (0, 1, 10**6)] == [0.5] * 3


def test_linear_is_a_straight_line_after_the_delay() -> None:
    schedule = Linear(start=1.0, end=0.0, steps=10, delay=5)
    assert [schedule(s) for s in (0, 5, 6, 10, 15, 100)] == pytest.approx([1, 1, 0.9, 0.5, 0, 0])


def test_cosine_against_its_formula() -> None:
    schedule = Cosine(start=3.0, end=1.0, steps=8)
    for step in range(9):
        assert schedule(step) == pytest.approx(1 + 2 * (1 + math.cos(math.pi * step / 8)) / 2)


def test_exponential_has_equal_ratios() -> None:
    schedule = Exponential(start=0.1, end=0.001, steps=100)
    values = [schedule(step) for step in range(101)]
    assert values[0] == pytest.approx(0.1)
    assert values[50] == pytest.approx(0.01)
    assert values[100] == pytest.approx(0.001)
    ratios = [b / a for a, b in itertools.pairwise(values)]
    assert max(ratios) == pytest.approx(min(ratios))


def test_piecewise_goes_through_its_knots() -> None:
    schedule = Piecewise(steps=[0, 10, 20], values=[0.0, 1.0, 0.5])
    assert [schedule(s) for s in (0, 5, 10, 15, 20, 99)] == pytest.approx([0, 0.5, 1, 0.75, 0.5, 0.5])


def test_zero_steps_is_a_jump() -> None:
    schedule = Linear(start=0.0, end=1.0, steps=0, delay=3)
    assert [schedule(s) for s in (2, 3, 4)] == [0.0, 1.0, 1.0]


@given(st.floats(0.01, 100), st.floats(0.01, 100), st.integers(0, 1000), st.integers(0, 1000), st.integers(0, 3000))
def test_ramps_stay_between_their_ends(start: float, end: float, steps: int, delay: int, step: int) -> None:
    ramps: list[Schedule] = [kind(start, end, steps, delay) for kind in (Linear, Cosine, Exponential)]
    for ramp in ramps:
        assert min(start, end) * (1 - 1e-9) <= ramp(step) <= max(start, end) * (1 + 1e-9)


def test_exponential_refuses_zero() -> None:
    with pytest.raises(ValueError, match=r"end = 0\.0 must both be above 0"):
        Exponential(start=1.0, end=0.0, steps=10)


@pytest.mark.parametrize(("steps", "values"), [([], []), ([0, 1], [1.0]), ([0, 5, 5], [1.0, 2.0, 3.0])])
def test_piecewise_refuses(steps: list[int], values: list[float]) -> None:
    with pytest.raises(ValueError, match="steps"):
        Piecewise(steps=steps, values=values)


def test_a_curriculum_draws_uniformly_up_to_a_number_that_grows() -> None:
    schedule = Curriculum(every=1000, delay=500)
    assert {schedule(step) for step in range(1500)} == {1.0}
    assert {schedule(step) for step in range(1500, 2500)} == {1.0, 2.0}
    drawn = [schedule(step) for step in range(2500, 3500)]
    assert all(abs(drawn.count(n) - 1000 / 3) < 100 for n in (1.0, 2.0, 3.0))
    assert drawn == [schedule(step) for step in range(2500, 3500)]
    assert drawn != [Curriculum(1000, 500, seed=1)(step) for step in range(2500, 3500)]
