"""A sweep that is killed again and again ends with the tables of one that was left alone."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from apex_lab.runs.state import read_state
from tests.conftest import REPOSITORY
from tests.kills import works
from tests.kills.test_kills import SEED

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

WORDS = (
    "--config-dir",
    str(REPOSITORY / "tests" / "conf"),
    "+sweep=tiny",
    "data=squares",
    "scale=smoke",
    "evaluation.pictures=0",
    "trainer.max_steps=30",
    "trainer.checkpoint_interval=4",
    "trainer.validation_interval=10",
)
LAUNCHERS: dict[str, tuple[str, ...]] = {
    "basic": (),
    "joblib": ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2"),
    "submitit_local": ("hydra/launcher=submitit_local", "hydra.sweeper.slots=2"),
}
KILLS = 5
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


def command(entry: str, words: Sequence[str], folder: Path, pause: float = 0.0) -> subprocess.Popen[str]:
    """An entry point in a process group of its own."""
    environment = {
        **{name: value for name, value in os.environ.items() if not name.startswith(("APEX_LAB_", "SLURM_"))},
        "PYTHONPATH": os.pathsep.join([str(REPOSITORY / "src"), str(REPOSITORY)]),
        "TINY_PAUSE": str(pause),
    }
    return subprocess.Popen(
        [sys.executable, "-m", f"apex_lab.{entry}", *WORDS, *words],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def ended(process: subprocess.Popen[str]) -> str:
    """What a command said that must end well."""
    said, _ = process.communicate(timeout=600)
    assert process.returncode == 0, said
    return said


def scores(folder: Path) -> dict[str, Any]:
    """Every run's scores, by its folder; the time that it took left out."""
    found = {}
    for file in folder.glob("outputs/*/seed_*/metrics.json"):
        found[str(file.parent.relative_to(folder))] = json.loads(file.read_text())["splits"]
    return found


def tables(folder: Path) -> str:
    said = ended(command("tables", (), folder))
    return said.partition("outputs/tables/")[0]


def rows(folder: Path) -> int:
    """Rows of all curves: how far the sweep is."""
    return sum(len(file.read_text().splitlines()) for file in folder.glob("outputs/*/seed_*/curves.csv"))


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unbroken")
    ended(command("train", ("-m",), folder))
    return folder


def settled(folder: Path) -> None:
    """Waits until no run says that somebody works on it; jobs elsewhere notice the end of their sweep by themselves."""
    began = time.monotonic()
    while "running" in (states := [read_state(file.parent).state for file in folder.glob("outputs/*/seed_*/run.json")]):
        assert time.monotonic() - began < 120, states
        time.sleep(0.2)


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_the_same_tables_after_five_kills(launcher: str, unbroken: Path, tmp_path: Path) -> None:
    if launcher != "basic":
        pytest.importorskip(f"hydra_plugins.hydra_{launcher.partition('_')[0]}_launcher")
    draw = random.Random(f"{SEED} {launcher}")
    words = (*LAUNCHERS[launcher], "-m")
    kills: list[str] = []
    for _ in range(KILLS):
        before = rows(tmp_path)
        process = command("train", words, tmp_path, pause=0.05)
        began = time.monotonic()
        while rows(tmp_path) <= before and process.poll() is None and time.monotonic() - began < 240:
            time.sleep(0.05)
        time.sleep(draw.uniform(0.0, 1.5))
        number = draw.choice(SIGNALS)
        os.killpg(process.pid, number)
        said, _ = process.communicate(timeout=600)
        kills.append(f"{number.name} -> {process.returncode}")
        assert "Traceback" not in said, (kills, said)
        settled(tmp_path)
        assert works.not_whole(tmp_path) == [], kills
    said = ended(command("train", words, tmp_path))
    assert "8 jobs: 8 finished." in said
    assert scores(tmp_path) == scores(unbroken), kills
    assert tables(tmp_path) == tables(unbroken), kills
    print(f"sweep under {launcher} seed {SEED}: {len(kills)} kills ({', '.join(kills)})")
