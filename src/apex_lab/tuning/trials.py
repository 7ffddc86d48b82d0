"""Which trials of a study count, which are run again, and the best ones.

A lost or interrupted trial is failed in Optuna, and another one with the same values waits in its place: it names the
trial that it repeats (`retry_of`). The repeated one no longer counts, so a study of N trials has N places.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import optuna
from optuna.trial import FrozenTrial, TrialState

RETRY_OF, RETRIES, SURPLUS, REASON, BEGUN = "retry_of", "retries", "surplus", "reason", "begun"
"""Attributes of trials: number of the trial that is repeated; how often its worker was lost; a trial that two workers
began at once for the last place; why it failed or was pruned; set as soon as its worker has it."""


def run_again(study: optuna.Study, trial: FrozenTrial, lost: bool, most: int) -> bool:
    """Puts another trial with the same values in the place of a failed one.

    Args:
        study: which.
        trial: the failed one.
        lost: whether its worker died; that is done at most `most` times, an interrupt is free.
        most: see there.

    Returns:
        Whether it was.
    """
    retries = trial.user_attrs.get(RETRIES, 0) + int(lost)
    if retries > most:
        return False
    kept = {key: value for key, value in trial.user_attrs.items() if key not in (BEGUN, REASON)}
    study.add_trial(
        optuna.create_trial(
            state=TrialState.WAITING,
            params=trial.params,
            distributions=trial.distributions,
            intermediate_values=trial.intermediate_values,
            user_attrs={**kept, RETRY_OF: trial.number, RETRIES: retries},
        )
    )
    return True


def places(trials: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    """The trials that count, in the order in which their places were taken."""
    repeated = {trial.user_attrs[RETRY_OF] for trial in trials if RETRY_OF in trial.user_attrs}
    by_number = {trial.number: trial for trial in trials}
    counted = [t for t in trials if t.number not in repeated and not t.user_attrs.get(SURPLUS)]
    return sorted(counted, key=lambda trial: _root(trial, by_number))


def _root(trial: FrozenTrial, by_number: Mapping[int, FrozenTrial]) -> int:
    """Number of the first trial in its place."""
    while RETRY_OF in trial.user_attrs:
        trial = by_number[trial.user_attrs[RETRY_OF]]
    return trial.number


def is_surplus(trials: Sequence[FrozenTrial], number: int, wanted: int) -> bool:
    """Whether a trial that has just begun has no place: workers that ask at once can begin more than are wanted."""
    return number not in [trial.number for trial in places(trials)[:wanted]]


def ended(trials: Sequence[FrozenTrial]) -> list[FrozenTrial]:
    """Those that count and are complete, pruned or failed."""
    return [trial for trial in places(trials) if trial.state.is_finished()]


def best(trials: Sequence[FrozenTrial]) -> FrozenTrial | None:
    """The complete trial with the highest first objective, the earlier one of equals; None where none is complete.

    With several objectives no other trial is better in all of them than this one.
    """
    complete = [trial for trial in places(trials) if trial.state == TrialState.COMPLETE]
    return max(complete, key=lambda trial: tuple(trial.values), default=None)
