"""Any command, killed at random moments and started again: what it leaves, and what it ends with."""

from __future__ import annotations

import os
import random
import signal
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from apex_lab.runs.state import read_state
from tests.kills import works
from tests.kills.processes import Ended, Measured, Moment, Running, Tally, drawn, untold
from tests.kills.works import WORKS, Work

SEED = os.environ.get("KILLS_SEED", "0")
"""Another seed draws other moments."""

EVERY = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT, None)

FAST = {"training": 5, "evaluation": 5}
"""Kills of the default suite; docs/reliability.md counts them."""

SLOW = {
    **{"training": 8, "training with loaders": 3, "training with pictures": 6, "own videos": 8, "evaluation": 10},
    **{"prediction": 12, "sweep": 8, "simulation": 10, "arrangement clips": 8, "arrangement": 6, "example videos": 4},
    **{"arrangement video": 4},
    **{f"training {model}": 5 for model in works.MODELS},
}


def started(work: Work, folder: Path, inputs: Path, moment: Moment | None = None) -> Running:
    """A command at work in a folder."""
    folder.mkdir(exist_ok=True)
    words = [word.replace("{inputs}", str(inputs)) for word in work.words]
    return Running(work.entry, words, folder, moment, work.variables)


def check(folder: Path, moment: Moment, ended: Ended, told: str) -> None:
    """What must hold after every kill."""
    assert untold(moment, ended) is None, f"{untold(moment, ended)}: {told}\n{ended.said}"
    assert works.not_whole(folder) == [], told
    states = {str(file.parent): read_state(file.parent).state for file in folder.rglob("run.json")}
    assert "running" not in states.values(), (states, told)
    assert "damaged" not in states.values(), (states, told)


def kill(
    name: str,
    kills: int,
    folder: Path,
    inputs: Path,
    whole: tuple[dict[str, object], Measured],
    signals: Sequence[int | None] = EVERY,
) -> Tally:
    """Kills a command again and again, lets it end, and compares; what was done."""
    work, (expected, measured) = WORKS[name], whole
    draw, tally = random.Random(f"{SEED} {name}"), Tally(SEED)
    place, rounds = folder / "round_0", 0
    while tally.count < kills:
        assert len(tally.moments) < 6 * kills + 10, f"{tally} {tally.moments}"
        moment = drawn(draw, measured, signals, work.workers)
        ended = started(work, place, inputs, moment).end(work.workers)
        told = f"{name}, {tally}, {tally.moments}, {moment}"
        if tally.add(moment, ended):
            check(place, moment, ended, told)
            continue
        compare(work, place, expected, told)
        rounds += 1
        place = folder / f"round_{rounds}"
    ended = started(work, place, inputs).end()
    told = f"{name}, {tally}, {tally.moments}"
    assert ended.code == 0, f"{told}\n{ended.said}"
    compare(work, place, expected, told)
    return tally


def compare(work: Work, folder: Path, expected: dict[str, object], told: str) -> None:
    """A finished command has left what the unbroken one has left, and nothing in the making."""
    found = work.results(folder)
    assert found.keys() == expected.keys(), told
    assert [key for key in found if found[key] != expected[key]] == [], told
    assert works.in_the_making(folder) == [], told
    assert works.not_whole(folder) == [], told


@pytest.mark.parametrize("name", FAST)
def test_killed_at_random_moments_it_ends_as_unbroken(
    name: str, tmp_path: Path, inputs: Path, unbroken: Callable[[str], tuple[dict[str, object], Measured]]
) -> None:
    print(name, kill(name, FAST[name], tmp_path, inputs, unbroken(name), EVERY[:-1]))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", SLOW)
def test_killed_often_it_ends_as_unbroken(
    name: str, tmp_path: Path, inputs: Path, unbroken: Callable[[str], tuple[dict[str, object], Measured]]
) -> None:
    print(name, kill(name, SLOW[name], tmp_path, inputs, unbroken(name)))
