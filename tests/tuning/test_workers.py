"""Workers of a study without training: places, interrupts, lost workers, storages; and commands that are refused."""

from __future__ import annotations

import errno
import json
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import lightning as L
import optuna
import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf
from optuna.trial import TrialState

from apex_lab.base.errors import UserError
from apex_lab.base.files import unwritable
from apex_lab.base.interrupts import Interrupted
from apex_lab.config.composition import conf_dir, plain
from apex_lab.config.job import Job
from apex_lab.runs.folder import Busy, run_folder
from apex_lab.tuning import trial as one_trial
from apex_lab.tuning import workers
from apex_lab.tuning.settings import check_settings
from apex_lab.tuning.storage import GRACE, Journal, shown_url
from apex_lab.tuning.study import Study, check_study
from apex_lab.tuning.trials import BEGUN, RETRIES, RETRY_OF, SURPLUS, places
from apex_lab.tuning.workers import Worker
from tests.conftest import TINY

pytestmark = pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning", "ignore:Heartbeat of storage")

LR = "optimizer.lr=tag(log,interval(1e-3,1e-1))"


@pytest.fixture
def studies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Study]]:
    """studies("optimizer.lr=...", "study.trials=3") -> checked study, as the entry point makes it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["tune", *TINY[:2]])

    def make(*words: str) -> Study:
        own = [word for word in words if word.startswith("study")]
        config = compose("tune", overrides=[*own, "study.heartbeat_seconds=1"], return_hydra_config=True)
        raw = plain(OmegaConf.masked_copy(config, ["study", "paths"]))
        return check_study([*TINY[2:], *(w for w in words if w not in own)], TINY[1], raw, {})

    GlobalHydra.instance().clear()
    with initialize_config_dir(version_base="1.3", config_dir=str(conf_dir())):
        yield make


def finish(job: Job, callbacks: list[L.Callback], command: str) -> None:
    """A run that ends at once; its score is its learning rate."""
    folder = run_folder(job)
    folder.mkdir(parents=True, exist_ok=True)
    rate = job.raw["optimizer"]["lr"]
    (folder / "metrics.json").write_text(json.dumps({"splits": {"val": {"total": {"ari_fg": rate}, "terms": {}}}}))


def _study_of(study: Study) -> optuna.Study:
    storage = Journal(study.folder / "journal.log", 1, lambda study, trial: None)
    return optuna.load_study(study_name=study.name, storage=storage)


def test_a_worker_fills_all_places_and_a_second_start_adds_none(
    studies: Callable[..., Study], capsys: pytest.CaptureFixture[str]
) -> None:
    study = studies(LR, "study.trials=3")
    assert Worker(study, finish).work()
    found = _study_of(study)
    assert [trial.state for trial in found.get_trials()] == [TrialState.COMPLETE] * 3
    assert found.get_trials()[0].params == {"optimizer.lr": 0.01}  # the recipe's comes first
    assert found.best_value == max(trial.params["optimizer.lr"] for trial in found.get_trials())
    assert Worker(study, finish).work()
    assert len(_study_of(study).get_trials()) == 3
    more = studies(LR, "study.trials=4")
    assert more.name == study.name
    assert Worker(more, finish).work()
    assert len(_study_of(study).get_trials()) == 4


@pytest.mark.slow
def test_an_interrupted_trial_waits_for_the_next_worker(studies: Callable[..., Study]) -> None:
    study = studies(LR, "study.trials=2")

    def stopped(job: Job, callbacks: list[L.Callback], command: str) -> None:
        raise Interrupted(15)

    with pytest.raises(Interrupted):
        Worker(study, stopped).work()
    first, again = _study_of(study).get_trials()
    assert (first.state, again.state) == (TrialState.FAIL, TrialState.WAITING)
    assert again.user_attrs[RETRY_OF] == 0
    assert Worker(study, finish).work()
    trials = _study_of(study).get_trials()
    assert [trial.state for trial in trials] == [TrialState.FAIL, *[TrialState.COMPLETE] * 2]
    assert trials[1].params == trials[0].params
    assert trials[1].user_attrs["folders"] == trials[0].user_attrs["folders"]  # so its run resumes


@pytest.mark.parametrize(("number", "told"), [(errno.ENOSPC, True), (errno.EDQUOT, False), (errno.EROFS, True)])
def test_a_full_disk_ends_the_worker_and_the_trial_waits(
    number: int, told: bool, studies: Callable[..., Study], tmp_path: Path
) -> None:
    """As a run tells it, or as the system says it; every further trial would fail for the same reason."""
    study = studies(LR, "study.trials=2")
    calls = 0

    def full(job: Job, callbacks: list[L.Callback], command: str) -> None:
        nonlocal calls
        calls += 1
        try:
            raise OSError(number, os.strerror(number), str(tmp_path / "last.ckpt"))
        except OSError as error:
            if told:
                raise unwritable(tmp_path / "last.ckpt", error) from error
            raise

    with pytest.raises(UserError, match=r"^Trial 0 waits: .*/last\.ckpt .*\.$"):
        Worker(study, full).work()
    assert calls == 1
    first, again = _study_of(study).get_trials()
    assert (first.state, again.state) == (TrialState.FAIL, TrialState.WAITING)
    assert (again.user_attrs[RETRY_OF], again.user_attrs[RETRIES]) == (0, 0)
    assert Worker(study, finish).work()
    trials = _study_of(study).get_trials()
    assert [trial.state for trial in trials] == [TrialState.FAIL, *[TrialState.COMPLETE] * 2]
    assert trials[1].params == trials[0].params


def test_a_disk_that_takes_half_of_it_uses_up_no_place(
    studies: Callable[..., Study], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The trial can be put back, but not be recorded as over: its heartbeat ends it, and it is put back once."""
    study = studies(LR, "study.trials=1")
    worker = Worker(study, finish)

    def full(*_: object, **__: object) -> None:
        raise unwritable(study.folder / "journal.log", OSError(errno.ENOSPC, "No space left on device"))

    def stopped(job: Job, callbacks: list[L.Callback], command: str) -> None:
        monkeypatch.setattr(worker._optuna, "tell", full)
        raise Interrupted(15)

    worker._train = stopped
    with pytest.raises(UserError, match="No space left"):
        worker.work()
    first, again = _study_of(study).get_trials()
    assert (first.state, again.state) == (TrialState.RUNNING, TrialState.WAITING)
    alive = study.folder / "journal.log.alive" / str(first._trial_id)
    os.utime(alive, (time.time() - GRACE - 60,) * 2)
    assert Worker(study, finish).work()
    assert [trial.state for trial in _study_of(study).get_trials()] == [TrialState.FAIL, TrialState.COMPLETE]


@pytest.mark.slow
def test_a_failed_run_is_a_failed_trial_with_its_reason(studies: Callable[..., Study]) -> None:
    study = studies(LR, "study.trials=3")
    calls = 0

    def sometimes(job: Job, callbacks: list[L.Callback], command: str) -> None:
        nonlocal calls
        calls += 1
        if calls == 1:
            raise UserError("train/loss is nan at step 3.")
        if calls == 2:
            raise RuntimeError("the disk\nis gone")
        finish(job, callbacks, command)

    assert Worker(study, sometimes).work()
    trials = _study_of(study).get_trials()
    assert [trial.state for trial in trials] == [TrialState.FAIL, TrialState.FAIL, TrialState.COMPLETE]
    assert trials[0].user_attrs["reason"] == "train/loss is nan at step 3."
    assert trials[1].user_attrs["reason"] == "RuntimeError: the disk is gone"


@pytest.mark.slow
def test_a_study_without_a_complete_trial_says_why(studies: Callable[..., Study]) -> None:
    study = studies(LR, "study.trials=1")

    def broken(job: Job, callbacks: list[L.Callback], command: str) -> None:
        raise UserError("train/loss is nan at step 3.")

    with pytest.raises(UserError, match="completed: train/loss is nan at step 3"):
        workers.tune(study, broken)


@pytest.mark.slow
def test_lost_trials_are_taken_over(studies: Callable[..., Study], monkeypatch: pytest.MonkeyPatch) -> None:
    """One whose heartbeats stopped, and one whose worker died before its first."""
    study = studies(LR, "study.trials=3")
    first = Worker(study, finish)
    lost, unstarted = first._optuna.ask(), first._optuna.ask()
    lost.set_user_attr(BEGUN, "host:1")
    rate = lost.suggest_float("optimizer.lr", 1e-3, 1e-1, log=True)
    alive = study.folder / "journal.log.alive" / str(lost._trial_id)
    alive.touch()
    os.utime(alive, (time.time() - GRACE - 60,) * 2)
    monkeypatch.setattr(workers, "GRACE", 0.1)
    assert Worker(study, finish).work()
    trials = _study_of(study).get_trials()
    assert [t.state for t in trials if t.number in (lost.number, unstarted.number)] == [TrialState.FAIL] * 2
    assert sorted(t.user_attrs[RETRY_OF] for t in trials if RETRY_OF in t.user_attrs) == [0, 1]
    counted = places(trials)
    assert [trial.state for trial in counted] == [TrialState.COMPLETE] * 3
    assert counted[0].params == {"optimizer.lr": rate}
    assert {path.name for path in alive.parent.iterdir()} <= {"now", *(str(t._trial_id) for t in counted)}


@pytest.mark.slow
def test_a_trial_too_many_is_withdrawn(studies: Callable[..., Study], monkeypatch: pytest.MonkeyPatch) -> None:
    """Another worker takes the last place between our look and our question."""
    study = studies(LR, "study.trials=1")
    worker, other = Worker(study, finish), Worker(study, finish)
    taken = other._optuna.ask()
    worker._one()
    trials = _study_of(study).get_trials()
    assert [bool(t.user_attrs.get(SURPLUS)) for t in trials] == [False, True]
    assert [t.number for t in places(trials)] == [taken.number]


@pytest.mark.slow
def test_a_run_that_another_worker_trains_is_waited_for(
    studies: Callable[..., Study], monkeypatch: pytest.MonkeyPatch
) -> None:
    study = studies(LR, "study.trials=1")
    monkeypatch.setattr(one_trial, "BUSY_SECONDS", 0.01)
    calls = []

    def busy(job: Job, callbacks: list[L.Callback], command: str) -> None:
        calls.append(command)
        if len(calls) < 3:
            raise Busy("it is being worked on")
        finish(job, callbacks, command)

    assert Worker(study, busy).work()
    assert len(calls) == 3
    assert _study_of(study).best_trial.number == 0


def test_refused_settings(studies: Callable[..., Study]) -> None:
    for words, message in [
        ((), "A study varies something"),
        (("optimizer.lr=0.1",), "A study varies something"),
        (("model=choice(tiny,apex)",), "tunes values of one model"),
        (("seed=0,1",), r"write study.seeds=\[0,1\]"),
        (("data.workers=range(1,3)",), "is not a setting to tune"),
        (("evaluation.videos=range(1,3)",), "is not a setting to tune"),
        ((LR, "seed=3"), r"the seeds of a study are study.seeds=\[3\]"),
        ((LR, "evaluation.split=test"), "settings are chosen on validation videos alone"),
        ((LR, "study.objectives=[ari_gf]"), "did you mean 'ari_fg'"),
        ((LR, "study.unsupervised=true", "study.objectives=[ari_fg]"), "leave one of the two out"),
        ((LR, "study.trials=0"), "study.trials = 0 is wrong"),
        ((LR, "study.name=../x"), "study.name = '../x' is wrong"),
        ((LR, "study.seeds=[1,1]"), "name each once"),
        ((LR, "study.sampler.n_startup_trials=few"), "study.sampler.n_startup_trials = 'few' is wrong"),
    ]:
        with pytest.raises(UserError, match=message):
            studies(*words)


@pytest.mark.slow
def test_every_sampler_and_pruner_that_is_shipped(studies: Callable[..., Study]) -> None:
    for key in ("sampler", "pruner"):
        for file in (conf_dir() / "study" / key).glob("*.yaml"):
            raw = plain(compose("tune", overrides=[f"study/{key}={file.stem}"]))
            asked = check_settings(raw).study
            study = optuna.create_study(
                sampler=workers.sampler(asked, {}), pruner=workers.pruner(asked), direction="maximize"
            )
            for value in range(3):
                trial = study.ask()
                trial.suggest_int("x", 1, 4)
                trial.report(value, 1)
                trial.should_prune()
                study.tell(trial, value)


@pytest.mark.slow
def test_definition_and_words_of_a_trial(studies: Callable[..., Study]) -> None:
    study = studies(LR, "clips.batch_size=2", "trainer.log_interval=5")
    job = study.trial_job({"optimizer.lr": 0.05}, 0)
    assert job.config.optimizer is not None
    assert job.config.optimizer["lr"] == 0.05
    assert job.config.evaluation.split == "val"
    assert job.config.paths.outputs == str(study.folder)
    assert "--config-dir" in study.command(job)
    assert studies(LR, "clips.batch_size=2").name == study.name  # the logging interval cannot change a result
    others = {studies(LR, *more).name for more in (("clips.batch_size=3",), ("study.seeds=[1]",), ("loss.spread=2.0",))}
    assert len(others) == 3
    assert study.name not in others


def test_passwords_are_not_shown() -> None:
    assert shown_url("postgresql://me:secret@host/name") == "postgresql://me:***@host/name"
    assert shown_url("outputs/journal.log") == "outputs/journal.log"


@pytest.mark.slow
def test_unreadable_storages(studies: Callable[..., Study], tmp_path: Path) -> None:
    (tmp_path / "not.log").write_text('{"op_code": "what"}\n[]\n')
    for url, message in [
        (f"{tmp_path}/not.log", "is not a journal of Optuna"),
        ("sqlite:////proc/none/x.db", "cannot be"),
        ("nosuch://host/x", "cannot be opened"),
    ]:
        with pytest.raises(UserError, match=message):
            Worker(studies(LR, f"study.storage='{url}'"), finish)
