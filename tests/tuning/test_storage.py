"""The journal of a study after a worker has died in the middle of writing it."""

from __future__ import annotations

import time
from pathlib import Path

import optuna
import pytest

from apex_lab.tuning.storage import Journal

pytestmark = pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")


def journal(path: Path) -> Journal:
    return Journal(path, 15, lambda study, trial: None)


def test_the_lock_of_a_dead_worker_is_taken_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "studies").mkdir()
    path = Path("studies/journal.log")  # as the command line gives it
    journal(path)._backend._lock.acquire()  # and never released
    left = journal(path)
    left._backend._lock.grace_period = 1
    began = time.monotonic()
    optuna.create_study(study_name="killed", storage=left)
    assert 1 <= time.monotonic() - began < 30
    assert [study.study_name for study in optuna.get_all_study_summaries(journal(path))] == ["killed"]


def test_a_lock_that_leads_nowhere_is_removed(tmp_path: Path) -> None:
    (tmp_path / "journal.log.lock").symlink_to("studies/journal.log")
    optuna.create_study(study_name="old", storage=journal(tmp_path / "journal.log"))


@pytest.mark.parametrize("half", [b'{"op_code": 4, "wor', b"x" * 10_000])
def test_half_a_line_is_cut_off(half: bytes, tmp_path: Path) -> None:
    path = tmp_path / "journal.log"
    study = optuna.create_study(study_name="cut", storage=journal(path))
    study.enqueue_trial({"lr": 1.0})
    with open(path, "ab") as file:
        file.write(half)
    again = optuna.load_study(study_name="cut", storage=journal(path))
    again.enqueue_trial({"lr": 2.0})
    assert len(optuna.load_study(study_name="cut", storage=journal(path)).get_trials()) == 2
