"""Samplers whose draws depend on the study's seed and the trial's number, and the pruner."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import optuna
from optuna.distributions import BaseDistribution
from optuna.pruners import BasePruner
from optuna.samplers import BaseSampler
from optuna.trial import FrozenTrial, TrialState

from apex_lab.config import components
from apex_lab.tuning.settings import StudyPart
from apex_lab.tuning.space import Value


class ByNumber(BaseSampler):
    """A sampler with a seed of its own for every trial.

    Workers that share a seed would draw the same points, and a worker that starts again would repeat its first ones.

    Args:
        node: the sampler, as a component.
        seed: of the study.
        first: key -> value of trial 0, as far as it is known.
    """

    def __init__(self, node: Mapping[str, Any], seed: int, first: Mapping[str, Value]) -> None:
        self._node, self._seed, self._first = node, seed, first
        self._of: tuple[int, BaseSampler] | None = None

    def _sampler(self, trial: FrozenTrial) -> BaseSampler:
        if self._of is None or self._of[0] != trial.number:
            seed = int(np.random.SeedSequence([self._seed, trial.number]).generate_state(1)[0])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
                built = components.build(self._node, "study.sampler", seed=seed)
            assert isinstance(built, BaseSampler)
            self._of = (trial.number, built)
        return self._of[1]

    def reseed_rng(self) -> None:
        """Nothing: each trial has its seed."""

    def before_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        self._sampler(trial).before_trial(study, trial)

    def infer_relative_search_space(self, study: optuna.Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        if trial.number == 0:
            return {}
        return self._sampler(trial).infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: optuna.Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        if trial.number == 0:
            return {}
        return self._sampler(trial).sample_relative(study, trial, search_space)

    def sample_independent(
        self, study: optuna.Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        if trial.number == 0 and param_name in self._first:
            return self._first[param_name]
        return self._sampler(trial).sample_independent(study, trial, param_name, param_distribution)

    def after_trial(
        self, study: optuna.Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None
    ) -> None:
        self._sampler(trial).after_trial(study, trial, state, values)


def sampler(asked: StudyPart, recipe: Mapping[str, Value]) -> ByNumber:
    """The sampler of a study.

    Raises:
        UserError: its constructor refuses its values.
    """
    built = ByNumber(asked.sampler, asked.seed, recipe if asked.recipe_first else {})
    components.build(asked.sampler, "study.sampler", seed=0)
    return built


def pruner(asked: StudyPart) -> BasePruner:
    """The pruner of a study.

    Raises:
        UserError: its constructor refuses its values.
    """
    built = components.build(asked.pruner, "study.pruner")
    assert isinstance(built, BasePruner)
    return built
