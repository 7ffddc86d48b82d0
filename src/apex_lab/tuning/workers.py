"""One worker of a study: takes places until all are filled, repeats what other workers lost, and writes the results."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from typing import Any

import optuna
from optuna.trial import FrozenTrial, TrialState

from apex_lab.base import console, faults
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, takes_no_writes
from apex_lab.base.validation import one_line, shown
from apex_lab.runs import provenance
from apex_lab.tuning.plots import draw
from apex_lab.tuning.samplers import pruner, sampler
from apex_lab.tuning.settings import ELBO
from apex_lab.tuning.storage import GRACE, open_storage, shown_url
from apex_lab.tuning.study import Study, labelled
from apex_lab.tuning.trial import Train, objective
from apex_lab.tuning.trials import BEGUN, REASON, RETRY_OF, SURPLUS, best, ended, is_surplus, places, run_again
from apex_lab.tuning.tuned_file import write_tuned

POLL_SECONDS = 2.0
"""Between two looks at trials of other workers."""


def tune(study: Study, train: Train) -> None:
    """Works on a study until its trials are done, then writes plots and the best values.

    Args:
        study: a checked one.
        train: what makes a run.

    Raises:
        UserError: the storage cannot be opened, the study there is another one, data are missing, or no trial is
            complete in the end.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    worker = Worker(study, train)
    if worker.left and not labelled(study.base) and any(name != ELBO for name in study.asked.study.scores):
        raise UserError("The validation videos have no labels: write unsupervised=true.")
    if worker.work():
        worker.report()


class Worker:
    """A process that shares a study with others.

    Args:
        study: a checked one.
        train: what makes a run.
    """

    def __init__(self, study: Study, train: Train) -> None:
        self._study, self._train, self._asked = study, train, study.asked.study
        make_folder(study.folder)
        storage = open_storage(self._asked.storage, study.folder, self._asked.heartbeat_seconds, self._lost)
        self._optuna = optuna.create_study(
            study_name=study.name,
            storage=storage,
            sampler=sampler(self._asked, study.recipe),
            pruner=pruner(self._asked),
            directions=["maximize"] * len(self._asked.scores),
            load_if_exists=True,
        )
        self._same_study()
        self._unstarted: dict[int, float] = {}
        self._ends = time.monotonic() + 60 * self._asked.max_minutes if self._asked.max_minutes else None

    @property
    def left(self) -> int:
        """Trials that have not ended."""
        return max(0, self._asked.trials - len(ended(self._trials())))

    def _trials(self) -> list[FrozenTrial]:
        return self._optuna.get_trials(deepcopy=False)

    def _same_study(self) -> None:
        """Refuses to go on with a study of other content under the same name."""
        known, own = self._optuna.user_attrs.get("definition"), self._study.definition
        if known is None:
            self._optuna.set_user_attr("definition", own)
            self._optuna.set_user_attr("made_by", {"versions": provenance.versions(), "commit": provenance.commit()[0]})
            self._optuna.set_metric_names(list(self._asked.scores))
        elif known != own:
            part = next(key for key in own if known.get(key) != own[key])
            raise UserError(
                f"study.name = '{self._study.name}' is another study (its {part} is {shown(known.get(part))}, now "
                f"{shown(own[part])}): choose another name."
            )

    def work(self) -> bool:
        """Runs trials until all places are filled and their trials have ended.

        Returns:
            False where study.max_minutes ended it before.
        """
        where = shown_url(self._asked.storage) if self._asked.storage is not None else "journal.log there"
        console.say(
            f"study {self._study.name}: {self._asked.trials - self.left} of {self._asked.trials} trials done; "
            f"files in {self._study.folder}, storage: {where}"
        )
        if self._study.several:
            console.say("several objectives: no trial is pruned, since Optuna compares one value alone.")
        waits = False
        while self.left:
            if self._ends is not None and time.monotonic() >= self._ends:
                console.say(f"study.max_minutes is over, {self.left} trials are left; the same command resumes.")
                return False
            trials = self._trials()
            if any(t.state == TrialState.WAITING for t in trials) or len(places(trials)) < self._asked.trials:
                self._one()
                waits = False
                continue
            if not waits:
                console.say("waiting for trials of other workers; one whose worker is lost is run again here.")
            waits = True
            time.sleep(min(POLL_SECONDS, self._asked.heartbeat_seconds))
            optuna.storages.fail_stale_trials(self._optuna)
            self._fail_unstarted(trials)
        return True

    def _one(self) -> None:
        """One trial; what ends it early is recorded before it goes on to the caller.

        Raises:
            UserError: the disk is full; the trial waits, since all others would fail as well.
        """
        began = time.monotonic()
        number: int | None = None

        def run(trial: optuna.Trial) -> Any:
            nonlocal number
            number = trial.number
            if is_surplus(self._trials(), trial.number, self._asked.trials):
                trial.set_user_attr(SURPLUS, True)
                raise _Surplus
            try:
                return objective(self._study, trial, self._train)
            except Exception as error:
                if takes_no_writes(error):
                    raise _NoRoom(str(error) if isinstance(error, UserError) else faults.told(error)) from error
                if isinstance(error, UserError | optuna.TrialPruned):
                    trial.set_user_attr(REASON, str(error))
                    raise
                trial.set_user_attr(REASON, f"{type(error).__name__}: {one_line(error)}")
                raise

        try:
            self._optuna.optimize(run, n_trials=1, catch=(Exception,))
        except optuna.exceptions.UpdateFinishedTrialError:
            console.warn(f"trial {number}: its heartbeats came too late, so another worker has taken it over.")
            return
        except BaseException as stop:  # Ctrl-C, SIGTERM, a full disk
            if number is not None:
                self._give_back(number)
            if isinstance(stop, _NoRoom):
                raise UserError(f"Trial {number} waits: {stop}") from stop
            raise
        found = next(t for t in self._trials() if t.number == number)
        if not found.user_attrs.get(SURPLUS):
            self._tell(found, time.monotonic() - began)

    def _give_back(self, number: int) -> None:
        """Puts an interrupted trial back, for the next worker that asks."""
        trial = next(t for t in self._trials() if t.number == number)
        if trial.state == TrialState.RUNNING:
            # in this order a disk that takes the first alone leaves no failed trial in the place
            run_again(self._optuna, trial, lost=False, most=self._asked.retries)
            self._optuna.tell(number, state=TrialState.FAIL)

    def _lost(self, study: optuna.Study, trial: FrozenTrial) -> None:
        """Called by Optuna with a trial whose heartbeat stopped."""
        if any(t.user_attrs.get(RETRY_OF) == trial.number for t in study.get_trials(deepcopy=False)):
            return  # its worker could still put it back
        again = run_again(study, trial, lost=True, most=self._asked.retries)
        then = "it is run again" if again else f"after study.retries = {self._asked.retries} it counts as failed"
        console.say(f"trial {trial.number}: its worker {trial.user_attrs.get(BEGUN, '')} is lost; {then}.")

    def _fail_unstarted(self, trials: Sequence[FrozenTrial]) -> None:
        """Takes over trials whose worker died before its first heartbeat, which Optuna does not miss."""
        now = time.monotonic()
        quiet = [t.number for t in trials if t.state == TrialState.RUNNING and BEGUN not in t.user_attrs]
        self._unstarted = {number: self._unstarted.get(number, now) for number in quiet}
        for number, seen in self._unstarted.items():
            if now - seen > GRACE * self._asked.heartbeat_seconds:
                trial = next(t for t in trials if t.number == number)
                try:
                    self._optuna.tell(number, state=TrialState.FAIL)
                except (ValueError, optuna.exceptions.UpdateFinishedTrialError):
                    continue  # another worker was faster
                self._lost(self._optuna, trial)

    def _tell(self, trial: FrozenTrial, seconds: float) -> None:
        """A line on a trial that has ended, with the best so far."""
        trials = self._trials()
        done = f"trial {trial.number} ({len(ended(trials))} of {self._asked.trials} done, {seconds:.0f} s)"
        values = ", ".join(f"{key} {_short(value)}" for key, value in trial.params.items())
        if trial.state == TrialState.COMPLETE:
            how = ", ".join(f"{name} {v:.4g}" for name, v in zip(self._asked.scores, trial.values, strict=True))
        else:
            how = f"{'' if trial.state == TrialState.PRUNED else 'failed: '}{trial.user_attrs.get(REASON)}"
        top = best(trials)
        so_far = f"; best {top.values[0]:.4g} (trial {top.number})" if top is not None else ""
        console.say(f"{done}: {how}; {values}{so_far}")

    def report(self) -> None:
        """Writes plots and the best values.

        Raises:
            UserError: no trial completed.
        """
        top = best(self._trials())
        if top is None:
            reasons = {t.user_attrs.get(REASON, "no reason recorded") for t in ended(self._trials())}
            raise UserError(f"No trial of {self._study.name} completed: {'; '.join(sorted(reasons))}")
        for path in draw(self._optuna, self._asked.scores, self._study.folder):
            console.say(str(path))
        failed = [t for t in ended(self._trials()) if t.state == TrialState.FAIL]
        if failed:
            console.warn(f"{len(failed)} trials failed: {', '.join(str(t.number) for t in failed)}.")
        write_tuned(self._study, top)


class _Surplus(Exception):
    """This trial has no place."""


class _NoRoom(BaseException):
    """The disk takes no writes; a BaseException, so that Optuna does not record a failed trial."""


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
