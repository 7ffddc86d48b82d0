"""One checked study: what is varied on what fixed configuration, what it is called, and the job of a trial."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import Quote, QuotedString

from apex_lab.base.errors import UserError
from apex_lab.config import components, preflight
from apex_lab.config.building import build_model
from apex_lab.config.composition import CHOICES
from apex_lab.config.job import Job, check_job
from apex_lab.config.upgrades import EXCLUDED, fingerprint
from apex_lab.runs.folder import run_folder
from apex_lab.scene import SceneModel
from apex_lab.tuning.settings import ELBO, TuneConfig, check_settings
from apex_lab.tuning.space import Parameter, Value, read

SPLIT = "val"
"""What settings are chosen on; a study never scores test videos."""

OF_TRIALS = (f"evaluation.split={SPLIT}", "evaluation.pictures=0")
"""Words of every trial, before the study's own and those of the command line."""


@dataclass(frozen=True)
class Study:
    """One checked command.

    Attributes:
        asked: the study's own keys.
        word: study.name, else what `+study=` chose, else "study".
        named: whether one of the first two.
        words: fixed overrides of every trial.
        own: how the study's file sets keys that it does not vary, without what the command line replaced.
        parameters: what varies.
        base: a job inside the space, with the first seed: model, scale and data of all trials.
        recipe: key -> value that the recipe has, where the space holds it.
        config_dir: folder given as `--config-dir`.
    """

    asked: TuneConfig
    word: str
    named: bool
    words: tuple[str, ...]
    own: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    base: Job
    recipe: dict[str, Value]
    config_dir: str | None = None

    @cached_property
    def definition(self) -> dict[str, Any]:
        """What makes two studies the same: plain values."""
        return {
            "parameters": {p.prefix + p.key: p.text for p in self.parameters},
            "objectives": list(self.asked.study.scores),
            "seeds": list(self.asked.study.seeds),
            "configuration": fingerprint(self.base.raw),
        }

    @property
    def name(self) -> str:
        """What storage and folder call it; the same command finds the same study."""
        if self.asked.study.name is not None:
            return self.asked.study.name
        canonical = json.dumps(self.definition, sort_keys=True)
        groups = ("model", "ablation", "tuned", "data", "scale")
        named = [self.word, *(self.base.choices[group] for group in groups if group in self.base.choices)]
        return f"{'_'.join(named)}_{hashlib.sha256(canonical.encode()).hexdigest()[:8]}"

    @property
    def tuned(self) -> str:
        """What `+tuned=` calls its values: its own name, which no shipped file has (a dot would end the word)."""
        return self.name.replace(".", "_")

    @property
    def folder(self) -> Path:
        """Where its files lie, the trials' run folders among them."""
        return Path(self.asked.paths.outputs) / "studies" / self.name

    @property
    def several(self) -> bool:
        """Whether it has several objectives."""
        return len(self.asked.study.scores) > 1

    def trial_words(self, values: Mapping[str, Value], seed: int) -> list[str]:
        """The overrides of a run of a trial."""
        swept = [p.word(values[p.key]) for p in self.parameters]
        outputs = QuotedString(str(self.folder), Quote.single).with_quotes()
        fixed = [word for word in self.words if not word.startswith("paths.outputs=")]
        return [*fixed, f"paths.outputs={outputs}", *swept, f"seed={seed}"]

    def trial_job(self, values: Mapping[str, Value], seed: int) -> Job:
        """A run of a trial.

        Raises:
            UserError: these values do not go together.
        """
        return _job(self.trial_words(values, seed))

    def command(self, job: Job) -> str:
        """What repeats a trial's run by itself."""
        searched = ["--config-dir", self.config_dir] if self.config_dir is not None else []
        return shlex.join(["python", "-m", "apex_lab.train", *job.overrides, *searched])


def is_of_study(key: str) -> bool:
    """Whether an override belongs to the study itself; all others are words of `apex_lab.train`."""
    return key in ("study", "unsupervised") or key.startswith(("study.", "study/", "study@", "hydra."))


def check_study(
    train_words: Sequence[str], config_dir: str | None, raw: dict[str, Any], choices: Mapping[str, str]
) -> Study:
    """Checks the study's keys, and the configuration of trials over the whole space, before the first one starts.

    Every choice is composed and checked as `apex_lab.train` checks a job, and both ends and the middle of every span.

    Args:
        train_words: overrides of `apex_lab.train`, fixed and swept.
        config_dir: folder given as `--config-dir`.
        raw: the study's own configuration, plain.
        choices: group -> word of that configuration.

    Raises:
        UserError: the first fault, in one sentence.
    """
    asked = check_settings(raw)
    fixed, parameters = read([*OF_TRIALS, *asked.study.overrides, *train_words])
    _refuse(fixed, parameters)
    recipe = _without(fixed)
    if recipe is not None:
        _refuse_untrained(recipe)
    first = {p.key: p.samples()[0] for p in parameters}
    own = [word for word in fixed if word in asked.study.overrides]
    word = asked.study.name or choices.get("study")
    unnamed = Study(
        asked=asked,
        word=word or "study",
        named=word is not None,
        words=tuple(fixed),
        own=tuple(own),
        parameters=tuple(parameters),
        base=_job([*fixed, *(p.word(first[p.key]) for p in parameters), f"seed={asked.study.seeds[0]}"]),
        recipe=_recipe(recipe, parameters),
        config_dir=config_dir,
    )
    study = replace(unnamed, asked=_with_outputs(asked, unnamed.base))
    last = {p.key: p.samples()[-1] for p in parameters}
    for values in (last, *({**first, p.key: value} for p in parameters for value in p.samples()[1:])):
        study.trial_job(values, asked.study.seeds[0])
    _check_base(study)
    return study


def _job(words: Sequence[str]) -> Job:
    job = preflight.job_of("train", words, check_job)
    assert isinstance(job, Job)
    return job


def _with_outputs(asked: TuneConfig, base: Job) -> TuneConfig:
    """The study's paths are those of its runs."""
    return asked.model_copy(update={"paths": base.config.paths})


def _without(fixed: Sequence[str]) -> Job | None:
    """The run without the swept words; None where it needs one of them."""
    try:
        return _job(fixed)
    except UserError:
        return None


def _refuse_untrained(job: Job) -> SceneModel:
    """A study of a model without training would have nothing to do; the model of one that has."""
    model = build_model(job.config)
    if not model.needs_training:
        raise UserError(f"model={job.choices.get('model')} is not trained, so nothing can be pruned or tuned.")
    return model


def _recipe(job: Job | None, parameters: Sequence[Parameter]) -> dict[str, Value]:
    """The values that a run without the swept words has, where the space holds them."""
    if job is None:
        return {}
    found: dict[str, Value] = {}
    for p in parameters:
        value: Any = job.raw if "/" not in p.key else job.choices.get(p.key)
        for part in p.key.split(".") if "/" not in p.key else ():
            value = value.get(part) if isinstance(value, Mapping) else None
        if p.holds(value):
            found[p.key] = value
    return found


def _refuse(fixed: Sequence[str], parameters: Sequence[Parameter]) -> None:
    """Words that would make a trial something else than an ordinary run with chosen values."""
    if not parameters:
        raise UserError(
            "A study varies something: choose one with +study=..., "
            "or write 'optimizer.lr=tag(log,interval(1e-4,1e-2))'."
        )
    for p in parameters:
        if p.key in (*CHOICES, "trainer", "logger", "callbacks", "paths"):
            raise UserError(
                f"{p.prefix}{p.key}={p.text}: a study tunes values of one model on one data set; "
                "runs of several are a sweep of apex_lab.train, with -m."
            )
        if any(p.key == key or p.key.startswith(f"{key}.") for key in (*EXCLUDED, "evaluation")):
            hint = "write study.seeds=[0,1]" if p.key == "seed" else "leave it out"
            raise UserError(f"{p.prefix}{p.key}={p.text} is not a setting to tune: {hint}.")
    for word in fixed:
        key, _, value = word.lstrip("+").partition("=")
        if key == "seed":
            raise UserError(f"{word}: the seeds of a study are study.seeds=[{value}].")
        if key == "evaluation.split" and value != SPLIT:
            raise UserError(f"{word}: settings are chosen on validation videos alone: leave it out.")


def _check_base(study: Study) -> None:
    """Objectives that the model can have."""
    job, scores = study.base, study.asked.study.scores
    if job.config.evaluation.split != SPLIT:  # an experiment chose another
        raise UserError(f"evaluation.split is '{job.config.evaluation.split}': write evaluation.split={SPLIT}.")
    minutes = job.config.trainer.max_minutes
    if minutes is not None:
        raise UserError(
            f"trainer.max_minutes = {minutes:g} would end trials early: write study.max_minutes={minutes:g}."
        )
    model = _refuse_untrained(job)
    if ELBO in scores and "nll" not in model.term_names:
        raise UserError(
            f"study.objectives: model={job.choices.get('model')} has no likelihood (its loss terms are "
            f"{', '.join(model.term_names)}), so it has no ELBO: choose a score, such as ari_fg."
        )
    for name in ("mota", "match"):
        if name in scores and not model.tracks:
            raise UserError(f"study.objectives: model={job.choices.get('model')} does not track: leave {name} out.")


def labelled(job: Job) -> bool:
    """Makes the data set where it is missing, and says whether its validation videos have labels.

    Raises:
        UserError: the data cannot be made or read.
    """
    source = components.build(job.config.data, "data")
    source.prepare()
    source.open()
    return bool(source.sets[SPLIT].labelled)


def trial_folder(job: Job) -> Path:
    """Where a trial's run lies."""
    return run_folder(job)
