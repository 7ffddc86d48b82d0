"""Two workers of a study, killed again and again: every point is tried, with the value of an undisturbed study."""

from __future__ import annotations

import random
import signal
from pathlib import Path

import optuna
import pytest
from optuna.trial import TrialState

from apex_lab.runs.state import read_state
from apex_lab.tuning.storage import open_storage
from apex_lab.tuning.trials import places
from tests.conftest import TINY
from tests.kills import works
from tests.kills.processes import Moment, Running, untold
from tests.kills.test_kills import SEED

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(3600),
    pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning"),
]

KILLS = 6
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
RATES = (0.003, 0.006, 0.01, 0.02)


def worker(folder: Path, moment: Moment | None = None) -> Running:
    """One of them, at work."""
    rates = ",".join(map(str, RATES))
    words = (
        *(*TINY, f"optimizer.lr={rates}", "study/sampler=brute_force", f"study.trials={len(RATES)}"),
        *("study.name=killed", "study.heartbeat_seconds=1", "study.retries=20", f"study.conf={folder / 'conf'}"),
        *("trainer.max_steps=20", "trainer.checkpoint_interval=2", "trainer.validation_interval=10"),
    )
    folder.mkdir(exist_ok=True)
    return Running("apex_lab.tune", words, folder, moment, {"TINY_PAUSE": "0.1"})


def values(folder: Path) -> dict[float, float]:
    """Learning rate -> score, of a study in which all is done."""
    storage = open_storage(None, folder / "outputs" / "studies" / "killed", 15, lambda study, trial: None)
    trials = places(optuna.load_study(study_name="killed", storage=storage).get_trials())
    assert [trial.state for trial in trials] == [TrialState.COMPLETE] * len(RATES)
    return {trial.params["optimizer.lr"]: trial.values[0] for trial in trials}


def test_two_workers_killed_at_random_moments_end_as_unbroken(tmp_path: Path) -> None:
    whole = worker(tmp_path / "unbroken").end()
    assert whole.code == 0, whole.said
    expected = values(tmp_path / "unbroken")
    draw, kills, folder = random.Random(f"{SEED} tuning"), 0, tmp_path / "killed"
    told: list[str] = []
    for _ in range(3 * KILLS):
        if kills >= KILLS:
            break
        moments = [Moment(draw.choice(SIGNALS), seconds=draw.uniform(0.1, whole.measured.seconds)) for _ in range(2)]
        both = [worker(folder, moments[0]), worker(folder, moments[1] if draw.random() < 0.5 else None)]
        sent = [False, False]
        while any(one.process.exitcode is None for one in both):
            for number, one in enumerate(both):
                one.process.join(0.02)
                if one.moment is not None and not sent[number] and one.seconds() >= (one.moment.seconds or 0):
                    sent[number] = one.send()
        for one in both:
            ended = one.end()
            told.append(f"{one.moment} -> {ended.code}")
            if one.moment is not None:
                kills += ended.code != 0
                assert ended.code == 0 or untold(one.moment, ended) is None, (told, ended.said)
        assert works.not_whole(folder) == [], told
        states = [read_state(file.parent).state for file in folder.rglob("run.json")]
        assert "running" not in states, (states, told)
        if both[1].moment is None:
            assert values(folder) == expected, told  # whoever is left finishes the study
            folder = tmp_path / f"killed_{kills}"
    last = worker(folder).end()
    assert last.code == 0, (told, last.said)
    assert values(folder) == expected, told
    assert works.in_the_making(folder) == [], told
    print(f"tuning seed {SEED}: {kills} kills ({', '.join(told)})")
    assert kills >= KILLS
