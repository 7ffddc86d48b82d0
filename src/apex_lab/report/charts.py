"""Line charts as geometry: what the page draws as SVG, in both themes, with the page's own fonts and colours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from apex_lab.report.curves import Points, Spread

WIDTH, HEIGHT = 340, 235
LEFT, RIGHT, TOP, BOTTOM = 58, 8, 10, 40
DOTS = 25
"""Curves with at most so many points show each of them."""

CUT = 0.02
"""Share of the values at either end that an automatic axis may leave out."""


class Line(NamedTuple):
    """A configuration in a chart.

    Attributes:
        label: what the legend calls it.
        color: which of the page's colours, from 0.
        curves: of its seeds.
    """

    label: str
    color: int
    curves: Spread


class Tick(NamedTuple):
    """A place on an axis, in the chart's coordinates, and the number there."""

    at: float
    text: str


@dataclass(frozen=True)
class Drawn:
    """One configuration in the chart's coordinates.

    Attributes:
        label, color: see `Line`.
        thin: seed -> path.
        mean: path of the mean; empty where no seed is finished.
        band: path around mean ± deviation; empty with one seed.
        dots: places of single values.
        readings: (x, step, value) as they are shown under the pointer.
        last: the last reading, for the table under the chart; None without any.
        averaged: how many seeds the mean is over.
        seeds: how many are drawn.
    """

    label: str
    color: int
    thin: dict[int, str]
    mean: str
    band: str
    dots: list[tuple[float, float]]
    readings: list[tuple[float, str, str]]
    last: tuple[float, str, str] | None
    averaged: int
    seeds: int


@dataclass(frozen=True)
class Chart:
    """A chart.

    Attributes:
        title: the quantity.
        unit: what stands at the y axis.
        x_ticks, y_ticks: from left to right, from below to above.
        lines: in the order of the legend.
        remarks: sentences on what the chart does to the values.
    """

    title: str
    unit: str
    x_ticks: list[Tick]
    y_ticks: list[Tick]
    lines: list[Drawn]
    remarks: list[str]


def chart(title: str, unit: str, lines: Sequence[Line], limits: tuple[float, float] | None = None) -> Chart | None:
    """Draws one quantity of several configurations over the training step; None where there is no value.

    Args:
        title: the quantity.
        unit: for the y axis.
        lines: the configurations.
        limits: of the y axis, widened where values lie outside; None chooses an axis that leaves out at most `CUT` of
            the values at either end, logarithmic where positive values reach far above their median.
    """
    lines = [line for line in lines if line.curves.seeds]
    everything = [point for line in lines for points in line.curves.seeds.values() for point in points]
    if not everything:
        return None
    values = sorted(value for _, value in everything)
    last = max(step for step, _ in everything)
    remarks = []
    logarithmic = limits is None and values[0] > 0 and values[-1] > 30 * values[len(values) // 2]
    if limits is not None:
        low, high = min(limits[0], values[0]), max(limits[1], values[-1])
    elif logarithmic:
        low, high = values[0], values[-1]
        remarks.append("Logarithmic axis.")
    else:
        low, high, outside = _range(values)
        if outside:
            remarks.append(f"Values up to {short(values[-1])} and down to {short(values[0])} lie outside the axis.")
    if any(line.curves.thinned for line in lines):
        remarks.append("Long curves are drawn as means over hundredths of the training.")
    axis = _Axis(last or 1.0, low, high, logarithmic)
    return Chart(title, unit, axis.x_ticks(), axis.y_ticks(), [_drawn(line, axis) for line in lines], remarks)


@dataclass(frozen=True)
class _Axis:
    """From steps and values to places in the chart."""

    last: float
    low: float
    high: float
    logarithmic: bool

    def x(self, step: float) -> float:
        return round(LEFT + (WIDTH - LEFT - RIGHT) * step / (1.03 * self.last), 1)

    def y(self, value: float) -> float:
        if self.logarithmic:
            share = (math.log(max(value, self.low)) - math.log(self.low)) / (math.log(self.high) - math.log(self.low))
        else:
            share = (value - self.low) / (self.high - self.low)
        # far away values would only make long numbers: the page cuts the lines off at the frame
        return round(HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * min(max(share, -2.0), 3.0), 1)

    def x_ticks(self) -> list[Tick]:
        return [Tick(self.x(step), short(step)) for step in round_numbers(0.0, self.last, 5)]

    def y_ticks(self) -> list[Tick]:
        if self.logarithmic:
            first, last = math.ceil(math.log10(self.low)), math.floor(math.log10(self.high))
            every = max(1, math.ceil((last - first + 1) / 6))
            decades = [10.0**n for n in range(first, last + 1, every)]
            numbers = decades if len(decades) > 1 else [self.low, self.high]
        else:
            numbers = round_numbers(self.low, self.high, 5)
        return [Tick(self.y(number), short(number)) for number in numbers]


def _range(values: Sequence[float]) -> tuple[float, float, bool]:
    """An axis for sorted values: its ends, and whether values lie outside."""
    low, high = values[int(CUT * (len(values) - 1))], values[math.ceil((1 - CUT) * (len(values) - 1))]
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    reach = 2 * (high - low)
    if values[0] >= low - reach and values[-1] <= high + reach:
        return values[0] - margin, values[-1] + margin, False
    return low - margin, high + margin, True


def _drawn(line: Line, axis: _Axis) -> Drawn:
    curves = line.curves
    mean = curves.mean
    readings = []
    for i, (step, value) in enumerate(mean):
        text = short(value) + (f" ± {short(curves.deviation[i])}" if curves.deviation is not None else "")
        readings.append((axis.x(step), short(step), text))
    band = ""
    if curves.deviation is not None and len(mean) > 1:
        pairs = list(zip(mean, curves.deviation, strict=True))
        above = [(step, value + deviation) for (step, value), deviation in pairs]
        below = [(step, value - deviation) for (step, value), deviation in reversed(pairs)]
        band = _path([*above, *below], axis) + "Z"
    shown = mean or next(iter(curves.seeds.values()))
    dots = [(axis.x(step), axis.y(value)) for step, value in shown] if len(shown) <= DOTS else []
    if len(mean) == 1 and curves.averaged > 1:  # a band of one point has no width: its seeds show the spread
        dots += [(axis.x(step), axis.y(value)) for points in curves.seeds.values() for step, value in points[:1]]
    return Drawn(
        label=line.label,
        color=line.color,
        thin={seed: _path(points, axis) for seed, points in curves.seeds.items()},
        mean=_path(mean, axis),
        band=band,
        dots=dots,
        readings=readings,
        last=readings[-1] if readings else None,
        averaged=curves.averaged,
        seeds=len(curves.seeds),
    )


def _path(points: Points, axis: _Axis) -> str:
    """An SVG path through points."""
    return "".join(f"{'L' if i else 'M'}{axis.x(x):g} {axis.y(y):g}" for i, (x, y) in enumerate(points))


def round_numbers(low: float, high: float, count: int) -> list[float]:
    """About `count` multiples of 1, 2 or 5 times a power of ten within an interval."""
    width = (high - low) / count
    power = 10.0 ** math.floor(math.log10(width))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= width * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [n * step for n in range(first, last + 1)]


def short(value: float) -> str:
    """A number in few characters: 0.82, 40k, −1.25M."""
    size = abs(value)
    for limit, sign in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if size >= limit:
            text = f"{value / {'G': 1e9, 'M': 1e6, 'k': 1e3}[sign]:.3g}{sign}"
            break
    else:
        text = f"{value:.0f}" if size >= 1000 else f"{value:.3g}"
    return text.replace("-", "−")
