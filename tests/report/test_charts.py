"""Charts: places, ticks, axes."""

from __future__ import annotations

import re

import pytest

from apex_lab.report.charts import BOTTOM, HEIGHT, LEFT, TOP, Chart, Line, chart, round_numbers, short
from apex_lab.report.curves import Points, spread


def drawn(points: Points, *more: Points, limits: tuple[float, float] | None = None) -> Chart:
    seeds = dict(enumerate([points, *more]))
    found = chart("Loss", "loss", [Line("APEX", 0, spread(seeds, seeds))], limits)
    assert found is not None
    return found


def test_scores_stand_where_their_ticks_say() -> None:
    found = drawn([(0.0, 0.0), (50.0, 0.5), (100.0, 1.0)], limits=(0, 1))
    numbers = [float(text) for text in re.findall(r"[\d.]+", found.lines[0].mean)]
    assert numbers[:2] == [LEFT, HEIGHT - BOTTOM]
    assert numbers[3] == pytest.approx((TOP + HEIGHT - BOTTOM) / 2, abs=0.1)
    assert numbers[5] == TOP
    assert [tick.text for tick in found.y_ticks] == ["0", "0.2", "0.4", "0.6", "0.8", "1"]
    assert [tick.text for tick in found.x_ticks] == ["0", "20", "40", "60", "80", "100"]
    assert found.x_ticks[-1].at == numbers[4]


def test_limits_grow_where_values_lie_outside() -> None:
    found = drawn([(1.0, -0.3), (2.0, 0.9)], limits=(0, 1))
    assert float(re.findall(r" ([\d.]+)", found.lines[0].mean)[0]) == HEIGHT - BOTTOM
    assert found.y_ticks[0].text == "0"
    assert found.y_ticks[0].at < HEIGHT - BOTTOM


def test_a_few_far_values_do_not_flatten_a_curve() -> None:
    found = drawn([(1.0, 1e6), *((float(step), float(-step)) for step in range(2, 90))])
    assert [tick.text for tick in found.y_ticks] == ["−80", "−60", "−40", "−20", "0"]
    assert found.remarks == ["Values up to 1M and down to −89 lie outside the axis."]


def test_values_that_fall_by_decades_have_a_logarithmic_axis() -> None:
    found = drawn([(float(step), 10.0 ** (4 - step)) for step in range(8)])
    assert found.remarks == ["Logarithmic axis."]
    assert [tick.text for tick in found.y_ticks] == ["0.001", "0.1", "10", "1000"]


@pytest.mark.parametrize("value", [0.0, 5.0, -3.0, 1e-12])
def test_a_constant_is_a_line_in_the_middle(value: float) -> None:
    found = drawn([(1.0, value), (2.0, value)])
    heights = [float(y) for y in re.findall(r" ([\d.]+)", found.lines[0].mean)]
    assert heights == pytest.approx([(TOP + HEIGHT - BOTTOM) / 2] * 2, abs=0.1)


def test_no_value_no_chart() -> None:
    assert chart("Loss", "loss", [Line("APEX", 0, spread({0: []}, {0}))]) is None


def test_readings_give_mean_and_deviation() -> None:
    found = drawn([(1.0, 1.0), (2.0, 3.0)], [(1.0, 2.0), (2.0, 3.0)])
    assert [reading[1:] for reading in found.lines[0].readings] == [("1", "1.5 ± 0.707"), ("2", "3 ± 0")]
    assert found.lines[0].last == found.lines[0].readings[-1]
    assert found.lines[0].band.endswith("Z")


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0, 1, [0, 0.2, 0.4, 0.6, 0.8, 1]), (-7, 12, [-5, 0, 5, 10]), (0, 40000, [0, 10000, 20000, 30000, 40000])],
)
def test_ticks_are_round(low: float, high: float, expected: list[float]) -> None:
    assert round_numbers(low, high, 5) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0, "0"),
        (0.8234, "0.823"),
        (-1250, "−1250"),
        (40000, "40k"),
        (-1.25e6, "−1.25M"),
        (3e-5, "3e−05"),
        (2e10, "20G"),
    ],
)
def test_numbers_are_short(value: float, text: str) -> None:
    assert short(value) == text
