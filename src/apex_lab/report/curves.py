"""Curves of many runs: read from curves.csv, thinned, with mean and spread over seeds. Imports no pandas: it reads in
less time than pandas takes to be imported."""

from __future__ import annotations

import csv
import math
import statistics
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

POINTS = 100
"""A curve with more values than this is drawn as their means over so many stretches of the training."""

Points = list[tuple[float, float]]
"""(step, value) in the order of the steps."""


@dataclass(frozen=True)
class Spread:
    """The curves of one quantity and configuration.

    Attributes:
        seeds: seed -> its curve.
        mean: over the finished seeds, at the steps that all of them have; empty where none is finished.
        deviation: at each of those, sample deviation over them (n - 1); None with one seed.
        averaged: how many seeds the mean is over.
        thinned: whether values stand for stretches of the training.
    """

    seeds: Mapping[int, Points]
    mean: Points
    deviation: list[float] | None
    averaged: int
    thinned: bool


def read_curves(file: Path, columns: Collection[str]) -> dict[str, Points]:
    """The finite values of some columns of a run's curves.csv; nothing where it is missing or damaged.

    Of a step that was done twice, after a resumption, the later values count.
    """
    found: dict[str, dict[float, float]] = {}
    try:
        with open(file, newline="", encoding="utf-8") as opened:
            reader = csv.reader(opened)
            header = next(reader, [])
            if "step" not in header:
                return {}
            step_at = header.index("step")
            places = [(name, place) for place, name in enumerate(header) if name in columns]
            for row in reader:
                if len(row) != len(header):
                    continue  # cut off by a kill
                step = _number(row[step_at])
                if step is None:
                    continue
                for name, place in places:
                    value = _number(row[place])
                    if value is not None:
                        found.setdefault(name, {})[step] = value
    except (OSError, ValueError, csv.Error):
        return {}
    return {name: sorted(values.items()) for name, values in found.items()}


def _number(text: str) -> float | None:
    """A finite number; None for an empty cell and what is no number."""
    if not text:
        return None
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def spread(seeds: Mapping[int, Points], finished: Collection[int]) -> Spread:
    """Thins the curves of one configuration's seeds and averages those of the finished ones."""
    curves = {seed: points for seed, points in sorted(seeds.items()) if points}
    long = max((len(points) for points in curves.values()), default=0) > POINTS
    if long:
        last = max(points[-1][0] for points in curves.values())
        curves = {seed: thinned(points, last) for seed, points in curves.items()}
    whole = [dict(points) for seed, points in curves.items() if seed in finished]
    steps = sorted(set(whole[0]).intersection(*whole[1:])) if whole else []
    columns = [[curve[step] for curve in whole] for step in steps]
    mean = [(step, math.fsum(values) / len(values)) for step, values in zip(steps, columns, strict=True)]
    deviation = [statistics.stdev(values) for values in columns] if len(whole) > 1 else None
    return Spread(curves, mean, deviation, len(whole), long)


def thinned(points: Sequence[tuple[float, float]], last: float) -> Points:
    """The means of a curve over `POINTS` equal stretches from step 0 to `last`, each at its middle."""
    stretches: dict[int, list[float]] = {}
    width = last / POINTS
    for step, value in points:
        stretches.setdefault(min(int(step / width), POINTS - 1), []).append(value)
    return [((i + 0.5) * width, math.fsum(values) / len(values)) for i, values in sorted(stretches.items())]
