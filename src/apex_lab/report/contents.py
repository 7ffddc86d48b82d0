"""What a report says, as values: nothing here knows HTML or reads a command line."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from apex_lab.report.charts import Chart, Line, chart
from apex_lab.report.curves import Points, read_curves, spread
from apex_lab.report.pictures import Budget, Picture
from apex_lab.report.settings import Setting, compared, flat
from apex_lab.runs.state import RunState

COLORS = 8
"""Configurations in one chart: as many as the page has colours."""

CURVES, CURVE_SEEDS = 48, 8
"""At most so many configurations have curves, and so many seeds of each."""

SETTINGS = 60
"""At most so many configurations are printed in full."""

DONE = "finished"
BROKEN = ("failed", "damaged", "lost", "interrupted")
OPEN = ("waiting", "running", "paused")


@dataclass(frozen=True)
class Seed:
    """A job of the sweep.

    Attributes:
        number: its seed.
        state: of its run.
        command: that starts or resumes it.
    """

    number: int
    state: RunState
    command: str

    @property
    def hours(self) -> float:
        """Of training."""
        return self.state.seconds / 3600


@dataclass(frozen=True)
class Configuration:
    """A row of the sweep: one configuration with its seeds.

    Attributes:
        name: of its folder.
        label: for its reader; different for different configurations.
        model: what its model is called.
        choices: group -> the word chosen for it.
        settings: the resolved configuration.
        seeds: in their order.
    """

    name: str
    label: str
    model: str
    choices: Mapping[str, str]
    settings: Mapping[str, Any]
    seeds: tuple[Seed, ...]

    @property
    def finished(self) -> list[Seed]:
        """Seeds with results."""
        return [seed for seed in self.seeds if seed.state.state == DONE]

    @property
    def started(self) -> list[Seed]:
        """Seeds that have left something behind."""
        return [seed for seed in self.seeds if seed.state.state != "waiting"]

    @property
    def hours(self) -> float:
        """Of training, of all seeds."""
        return sum(seed.hours for seed in self.seeds)

    def of_state(self, *states: str) -> list[int]:
        """Numbers of the seeds in these states."""
        return [seed.number for seed in self.seeds if seed.state.state in states]


class Quantity(NamedTuple):
    """A column of curves.csv: its name, what the page calls it, the unit at its axis, the ends of its axis."""

    key: str
    title: str
    unit: str
    limits: tuple[float, float] | None


SCORES = (
    Quantity("val/ari_fg", "ARI-FG", "ARI-FG, validation", (0, 1)),
    Quantity("val/msc_fg", "MSC-FG", "MSC-FG, validation", (0, 1)),
    Quantity("val/ari", "ARI", "ARI, validation", (0, 1)),
    Quantity("val/msc", "MSC", "MSC, validation", (0, 1)),
    Quantity("val/mota", "MOTA", "MOTA in percent, validation", None),
    Quantity("diagnostics/live_objects", "Live objects", "objects per frame, training", None),
)
"""Quantities that mean the same in every model."""

LOSS = Quantity("train/loss", "Loss", "loss, training", None)
"""Drawn for each model by itself: models have losses of their own."""


@dataclass(frozen=True)
class Panel:
    """Charts with one legend.

    Attributes:
        title: what they have in common.
        legend: (label, colour) of each configuration.
        charts: one per quantity, then the losses.
    """

    title: str
    legend: list[tuple[str, int]]
    charts: list[Chart]


def panels(configurations: Sequence[Configuration]) -> tuple[list[Panel], list[str]]:
    """The curves of all configurations, and a sentence for each kind of curves that is left out."""
    trained = [one for one in configurations if any((seed.state.folder / "curves.csv").is_file() for seed in one.seeds)]
    shown, rest = trained[:CURVES], trained[CURVES:]
    remarks = []
    if rest:
        remarks.append(f"Curves of the first {CURVES} of {len(trained)} configurations; not of {_several(rest)}.")
    if any(len(one.started) > CURVE_SEEDS for one in shown):
        remarks.append(f"Curves, their means and bands are of the first {CURVE_SEEDS} seeds of each configuration.")
    found: list[Panel] = []
    by_task: dict[tuple[str, str], list[Configuration]] = {}
    for one in shown:
        by_task.setdefault((one.choices.get("data", ""), one.choices.get("scale", "")), []).append(one)
    for (data, scale), members in by_task.items():
        parts = [members[i : i + COLORS] for i in range(0, len(members), COLORS)]
        for number, part in enumerate(parts, 1):
            counted = f", part {number} of {len(parts)}" if len(parts) > 1 else ""
            panel = _panel(f"{data}, scale {scale}{counted}", part)
            if panel.charts:
                found.append(panel)
    return found, remarks


def _panel(title: str, configurations: Sequence[Configuration]) -> Panel:
    columns = [quantity.key for quantity in (*SCORES, LOSS)]
    read: list[dict[int, dict[str, Points]]] = [
        {seed.number: read_curves(seed.state.folder / "curves.csv", columns) for seed in one.started[:CURVE_SEEDS]}
        for one in configurations
    ]

    def lines(key: str, wanted: Iterable[int]) -> list[Line]:
        return [
            Line(
                configurations[i].label,
                i,
                spread(
                    {seed: curves.get(key, []) for seed, curves in read[i].items()},
                    {seed.number for seed in configurations[i].finished},
                ),
            )
            for i in wanted
        ]

    everyone = range(len(configurations))
    charts = [chart(one.title, one.unit, lines(one.key, everyone), one.limits) for one in SCORES]
    for model in dict.fromkeys(one.model for one in configurations):
        members = [i for i in everyone if configurations[i].model == model]
        charts.append(chart(f"{LOSS.title}, {model}", LOSS.unit, lines(LOSS.key, members), LOSS.limits))
    drawn = [one for one in charts if one is not None]
    used = {line.color for one in drawn for line in one.lines}
    return Panel(title, [(one.label, i) for i, one in enumerate(configurations) if i in used], drawn)


@dataclass(frozen=True)
class Pictures:
    """The pictures of a configuration.

    Attributes:
        label: of the configuration.
        seed: whose pictures they are: its first finished one with pictures.
        strip, movie: None where there is none, or no room.
    """

    label: str
    seed: int
    strip: Picture | None
    movie: Picture | None


def pictures(configurations: Sequence[Configuration], budget: Budget, movies: bool) -> list[Pictures]:
    """Film strips of all configurations, then movies as long as there is room."""
    chosen = [(one, seed) for one in configurations if (seed := _drawn_seed(one)) is not None]
    strips = [budget.strip(seed.state.folder) for _, seed in chosen]
    clips = [budget.movie(seed.state.folder) if movies else None for _, seed in chosen]
    return [
        Pictures(one.label, seed.number, strip, movie)
        for (one, seed), strip, movie in zip(chosen, strips, clips, strict=True)
        if strip is not None or movie is not None
    ]


def _drawn_seed(configuration: Configuration) -> Seed | None:
    """The first finished seed with pictures: no choice by their look or by their scores."""
    return next((seed for seed in configuration.finished if (seed.state.folder / "view").is_dir()), None)


@dataclass(frozen=True)
class Settings:
    """The resolved configuration of a row.

    Attributes:
        label: of the row.
        beside: label of the configuration it is compared with; None for the first.
        lines: all keys.
    """

    label: str
    beside: str | None
    lines: list[Setting]

    @property
    def different(self) -> list[Setting]:
        """Lines that differ from the configuration it is compared with."""
        return [line for line in self.lines if line.differs] if self.beside is not None else []

    @property
    def summary(self) -> str:
        """How many keys differ."""
        both = sum(line.value is not None and line.other is not None for line in self.different)
        one = len(self.different) - both
        parts = [f"{both} key{' differs' if both == 1 else 's differ'}"] if both else []
        parts += [f"{one} {'is' if one == 1 else 'are'} in one of the two"] if one else []
        return ", ".join(parts) or "no difference"


def settings(configurations: Sequence[Configuration]) -> tuple[list[Settings], list[str]]:
    """The configurations of the first rows, each beside the first of its model, or the first of all; those left out."""
    shown = configurations[:SETTINGS]
    found = []
    flats = [flat(one.settings) for one in shown]
    for i, one in enumerate(shown):
        same = [j for j in range(i) if shown[j].model == one.model]
        beside = same[0] if same else 0
        lines = compared(flats[i], flats[beside])
        found.append(Settings(one.label, shown[beside].label if i else None, lines))
    left_out = configurations[SETTINGS:]
    remarks = [f"Not printed, for there are more than {SETTINGS}: {_several(left_out)}."] if left_out else []
    return found, remarks


def counts(configurations: Sequence[Configuration]) -> Counter[str]:
    """State -> number of jobs."""
    return Counter(seed.state.state for one in configurations for seed in one.seeds)


def ranges(numbers: Sequence[int]) -> str:
    """Seeds in few characters: "0–3, 7"."""
    parts: list[list[int]] = []
    for number in sorted(numbers):
        if parts and number == parts[-1][-1] + 1:
            parts[-1].append(number)
        else:
            parts.append([number])
    return ", ".join(str(p[0]) if len(p) == 1 else f"{p[0]}–{p[-1]}" for p in parts)


def typed(words: Sequence[str], module: str = "train") -> str:
    """A command as one can type it."""
    return shlex.join(["python", "-m", f"apex_lab.{module}", *words])


def _several(configurations: Sequence[Configuration]) -> str:
    return ", ".join(one.label for one in configurations)


def size_text(file: Path) -> str:
    """The size of a file in megabytes or kilobytes."""
    size = file.stat().st_size
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{size / 1e3:.0f} kB"
