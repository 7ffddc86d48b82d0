"""Places of a study: repeated, surplus, lost and ended trials; draws of workers; the best trial."""

from __future__ import annotations

import optuna
import pytest
from optuna.trial import TrialState

from apex_lab.tuning.samplers import ByNumber
from apex_lab.tuning.trial import score_of
from apex_lab.tuning.trials import RETRIES, SURPLUS, best, ended, is_surplus, places, run_again

RANDOM = {"_target_": "optuna.samplers.RandomSampler"}


@pytest.fixture
def study() -> optuna.Study:
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return optuna.create_study(direction="maximize")


def _numbers(study: optuna.Study) -> list[int]:
    return [trial.number for trial in places(study.get_trials())]


def _failed(study: optuna.Study, trial: optuna.Trial) -> optuna.trial.FrozenTrial:
    study.tell(trial, state=TrialState.FAIL)
    return study.get_trials()[trial.number]


def test_a_lost_trial_is_run_again_with_its_values_in_its_place(study: optuna.Study) -> None:
    first, second = study.ask(), study.ask()
    value = first.suggest_float("x", 0, 1)
    first.report(0.25, 3)
    assert run_again(study, _failed(study, first), lost=True, most=3)
    assert _numbers(study) == [2, 1]
    again = study.ask()
    assert again.number == 2
    assert again.suggest_float("x", 0, 1) == value
    frozen = study.get_trials()[2]
    assert frozen.intermediate_values == {3: 0.25}
    assert frozen.user_attrs[RETRIES] == 1
    study.tell(again, 1.0)
    study.tell(second, 2.0)
    assert [trial.number for trial in ended(study.get_trials())] == [2, 1]


def test_a_worker_that_dies_every_time_ends_with_a_failed_trial(study: optuna.Study) -> None:
    for lost in range(3):
        trial = study.ask()
        trial.suggest_float("x", 0, 1)
        assert run_again(study, _failed(study, trial), lost=True, most=2) is (lost < 2)
    assert [t.state for t in places(study.get_trials())] == [TrialState.FAIL]


def test_an_interrupt_is_no_retry(study: optuna.Study) -> None:
    for _ in range(5):
        assert run_again(study, _failed(study, study.ask()), lost=False, most=0)
    assert [t.user_attrs[RETRIES] for t in places(study.get_trials())] == [0]


def test_two_workers_that_ask_for_the_last_place_fill_it_once(study: optuna.Study) -> None:
    trials = [study.ask() for _ in range(4)]
    assert [is_surplus(study.get_trials(), trial.number, 3) for trial in trials] == [False, False, False, True]
    # a trial that is lost and run again keeps its place before the one too many
    run_again(study, _failed(study, trials[1]), lost=True, most=3)
    assert is_surplus(study.get_trials(), 3, 3)
    assert not is_surplus(study.get_trials(), 4, 3)
    trials[3].set_user_attr(SURPLUS, True)
    study.tell(trials[3], state=TrialState.FAIL)
    assert _numbers(study) == [0, 4, 2]


def test_the_best_is_complete_and_the_earlier_of_equals(study: optuna.Study) -> None:
    assert best(study.get_trials()) is None
    for value in (1.0, 3.0, 3.0):
        study.tell(study.ask(), value)
    pruned = study.ask()
    pruned.report(9.0, 1)
    study.tell(pruned, state=TrialState.PRUNED)
    found = best(study.get_trials())
    assert found is not None
    assert found.number == 1


def test_workers_with_one_seed_draw_different_points_and_a_restart_repeats_none() -> None:
    storage = optuna.storages.InMemoryStorage()
    drawn: list[float] = []
    for _ in range(3):  # three workers, or one that starts three times
        study = optuna.create_study(
            study_name="s", storage=storage, sampler=ByNumber(RANDOM, 0, {"x": 0.5}), load_if_exists=True
        )
        for _ in range(2):
            trial = study.ask()
            drawn.append(trial.suggest_float("x", 0, 1))
            study.tell(trial, 0.0)
    assert drawn[0] == 0.5  # the recipe's value comes first
    assert len(set(drawn)) == 6
    other = optuna.create_study(sampler=ByNumber(RANDOM, 0, {}))
    assert [other.ask().suggest_float("x", 0, 1) for _ in range(6)][1:] == drawn[1:]


def test_objectives_from_scores_and_terms() -> None:
    terms = {"nll": -100.0, "kl_what": 3.0, "kl_pres": 2.0, "mask_entropy": 50.0}
    assert score_of("ari_fg", {"ari_fg": 0.5}, terms) == 0.5
    assert score_of("ari_fg", {"ari_fg": None}, terms) is None
    assert score_of("ari_fg", {"ari_fg": float("nan")}, terms) is None
    assert score_of("elbo", {}, terms) == 95.0
    assert score_of("elbo", {}, {"mse": 1.0}) is None
    assert score_of("elbo", {}, {**terms, "kl_what": float("inf")}) is None
