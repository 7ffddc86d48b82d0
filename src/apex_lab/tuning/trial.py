"""One trial: its runs, one per seed, what they report on the way, and the mean of their validation scores."""

from __future__ import annotations

import math
import os
import socket
import time
from collections.abc import Callable, Mapping
from typing import Any

import lightning as L
import optuna

from apex_lab.base import console
from apex_lab.base.errors import Busy, UserError
from apex_lab.base.files import read_json
from apex_lab.config.job import Job
from apex_lab.runs.state import is_whole
from apex_lab.training.callbacks import Pruned
from apex_lab.training.learner import Learner
from apex_lab.tuning.settings import ELBO
from apex_lab.tuning.space import Value
from apex_lab.tuning.study import SPLIT, Study, trial_folder
from apex_lab.tuning.trials import BEGUN

Train = Callable[[Job, list[L.Callback], str], None]
"""Job, further callbacks, command for its record -> a finished run."""

BUSY_SECONDS = 5.0
"""Between two looks at a run that another process works in."""


class Watch(L.Callback):
    """Reports the objective after every validation, and ends the run where the pruner says so.

    What is reported is the mean over the seeds so far: the final scores of finished seeds and the latest of this one.
    Its step is the weight updates of all seeds together, so trials are compared after equal work.

    Args:
        trial: of Optuna.
        name: the objective.
        before: final scores of the seeds before this one.
        max_steps: weight updates of a run.
    """

    def __init__(self, trial: optuna.Trial, name: str, before: list[float], max_steps: int) -> None:
        self._trial, self._name, self._before = trial, name, before
        self._max_steps = max_steps
        self._hopeless: str | None = None

    def on_validation_end(self, trainer: L.Trainer, learner: L.LightningModule) -> None:
        assert isinstance(learner, Learner)
        metrics = {key: float(value) for key, value in trainer.callback_metrics.items()}
        terms = {key.removeprefix("val/"): value for key, value in metrics.items()}
        score = score_of(self._name, terms, terms)
        if score is None:
            return
        mean = math.fsum([*self._before, score]) / (len(self._before) + 1)
        step = len(self._before) * self._max_steps + learner.step
        self._trial.report(mean, step)
        if learner.step < self._max_steps and self._trial.should_prune():  # at the last step nothing is left to save
            self._hopeless = f"pruned at step {learner.step}: {self._name} {mean:.4g} promises less than earlier trials"

    def on_train_batch_start(self, trainer: L.Trainer, learner: L.LightningModule, *_: Any) -> None:
        """Ends the run here, where the checkpoint of the validation is stored."""
        if self._hopeless is not None:
            raise Pruned(self._hopeless)


def score_of(name: str, scores: Mapping[str, Any], terms: Mapping[str, Any]) -> float | None:
    """An objective from the scores and the loss terms of validation videos; None where it is undefined."""
    if name == ELBO:
        parts = [value for key, value in terms.items() if key == "nll" or key == "kl" or key.startswith("kl_")]
        found: Any = -math.fsum(parts) if "nll" in terms and None not in parts else None
    else:
        found = scores.get(name)
    return float(found) if found is not None and math.isfinite(found) else None


def objective(study: Study, trial: optuna.Trial, train: Train) -> tuple[float, ...]:
    """Trains and scores one trial.

    Args:
        study: which.
        trial: of Optuna.
        train: what makes a run.

    Returns:
        The mean of each objective over the seeds.

    Raises:
        optuna.TrialPruned: the pruner ended it.
        UserError: its values do not go together, its training diverged, or a score is undefined.
    """
    trial.set_user_attr(BEGUN, f"{socket.gethostname()}:{os.getpid()}")
    values: dict[str, Value] = {p.key: p.draw(trial) for p in study.parameters}
    names = study.asked.study.scores
    scores: list[tuple[float, ...]] = []
    folders: list[str] = []
    for seed in study.asked.study.seeds:
        job = study.trial_job(values, seed)
        folders.append(str(trial_folder(job)))
        trial.set_user_attr("folders", folders)
        before = [score[0] for score in scores]
        # Optuna takes reports of studies with one objective alone
        watch = [] if study.several else [Watch(trial, names[0], before, job.config.trainer.max_steps)]
        try:
            _when_free(train, job, [*watch], study.command(job))
        except Pruned as error:
            raise optuna.TrialPruned(str(error)) from error
        scores.append(_final(job, names))
        trial.set_user_attr("scores", scores)
    return tuple(math.fsum(column) / len(column) for column in zip(*scores, strict=True))


def _when_free(train: Train, job: Job, callbacks: list[L.Callback], command: str) -> None:
    """Trains; waits while another worker trains the very same run, as happens where there are few choices."""
    told = False
    while True:
        try:
            train(job, callbacks, command)
            return
        except Busy as error:
            if not told:
                console.say(f"waiting: {error}")
            told = True
            time.sleep(BUSY_SECONDS)


def _final(job: Job, names: tuple[str, ...]) -> tuple[float, ...]:
    """The objectives of a finished run: final weights, all validation videos that its evaluation looks at."""
    file = trial_folder(job) / "metrics.json"
    splits = read_json(file).get("splits")
    scored = splits.get(SPLIT) if isinstance(splits, dict) else None
    if not isinstance(scored, dict) or not is_whole(scored):
        raise UserError(f"{file} has no scores of the split '{SPLIT}': remove the run's folder and start again.")
    found = []
    for name in names:
        score = score_of(name, scored.get("total", {}), scored.get("terms", {}))
        if score is None:
            raise UserError(f"{name} is undefined on the validation videos.")
        found.append(score)
    return tuple(found)
