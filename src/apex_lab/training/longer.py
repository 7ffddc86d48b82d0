"""A finished run trained longer: a run that differs in `trainer.max_steps` alone begins where a shorter one ended.

`trainer.max_steps` is part of a run's name, so the longer run has a folder of its own, and the shorter one stays as it
is. What it takes over is what it would have made itself: data and noise of a step depend on (seed, step), and schedules
that have had other values are refused. Only the shorter run's last validation, where it was not due by
`trainer.validation_interval`, is none of the longer one's: its values are left out of the curves.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import replacing
from apex_lab.base.validation import one_line, sentence, validate
from apex_lab.config import initial, trust
from apex_lab.config.building import build_clip_frames, build_lr_scale, build_schedules, build_weights
from apex_lab.config.job import Job
from apex_lab.config.schema import Config
from apex_lab.config.upgrades import FORMAT, fingerprint
from apex_lab.runs import checkpoints
from apex_lab.runs.folder import Run
from apex_lab.runs.identity import stored_configuration, with_same_words
from apex_lab.runs.state import has_scores, read_state
from apex_lab.scene import SceneModel
from apex_lab.training.loggers import Curves
from apex_lab.training.schedules import in_evaluation

Number = Callable[[int], float | None]

ANEW = "Training starts from the beginning."


@dataclass(frozen=True)
class Shorter:
    """A finished run that a longer one can begin with.

    Attributes:
        folder: of the run.
        steps: weight updates that it was to make.
        raw: its configuration.
    """

    folder: Path
    steps: int
    raw: dict[str, Any]


class _NotSo(Exception):
    """Why a shorter run is not taken up, in a few words."""


def find(job: Job, known: Collection[str]) -> list[Shorter]:
    """Finished runs that a job can begin with, the longest first; where there are some, but none can be used, a line
    says why the longest cannot.

    Args:
        job: the longer run.
        known: names of classes that the command names besides the project's; configurations on the disk may name no
            others.
    """
    found: list[Shorter] = []
    reasons: list[str] = []
    for shorter in sorted(_candidates(job, known), key=lambda shorter: -shorter.steps):
        try:
            _compare(shorter, job.config)
            found.append(shorter)
        except _NotSo as why:
            reasons.append(_told(shorter, why))
    if reasons and not found:
        console.say(f"{reasons[0]} {ANEW}")
    return found


def _told(shorter: Shorter, why: _NotSo | UserError) -> str:
    return sentence(f"{shorter.folder}, the same run with {shorter.steps} steps, is not gone on with: {one_line(why)}")


def _candidates(job: Job, known: Collection[str]) -> Iterator[Shorter]:
    """Finished runs that differ in nothing but a smaller `trainer.max_steps` and scheduled values."""
    own, identity = job.raw, fingerprint(job.raw)
    for folder in with_same_words(Path(job.config.paths.outputs), job.choices, job.config.seed):
        state = read_state(folder)
        steps = state.record.get("max_steps")
        if state.state != "finished" or state.record.get("format") != FORMAT or not isinstance(steps, int):
            continue
        if not 0 < steps < job.config.trainer.max_steps:
            continue
        try:
            raw = stored_configuration(folder)
            scheduled = {key: own[key] for key in ("schedule", "loss", "lr_scale")}
            clips = {**raw["clips"], "frames": own["clips"]["frames"]}
            trainer = {**raw["trainer"], "max_steps": job.config.trainer.max_steps}
            if fingerprint({**raw, **scheduled, "clips": clips, "trainer": trainer}) == identity:
                if not has_scores(folder, job.config.evaluation.split):
                    continue
                trust.check(raw, str(folder / "config.yaml"), known)
                yield Shorter(folder, steps, raw)
        except (OSError, yaml.YAMLError, LookupError, TypeError, AttributeError, ValueError, RecursionError, UserError):
            continue  # it cannot be recognised


def _compare(shorter: Shorter, config: Config) -> None:
    """Compares all scheduled values at the steps that the shorter run has made.

    Raises:
        _NotSo: one was another.
    """
    try:
        before = validate(Config, shorter.raw, "")
        assert isinstance(before, Config)
        theirs = _scheduled(before)
    except UserError as error:
        raise _NotSo(f"its configuration is none of this version ({one_line(error)})") from error
    for key, (node, value) in _scheduled(config).items():
        node_before, value_before = theirs.get(key, (None, None))
        if value_before is None:
            raise _NotSo(f"it has no {key}")
        if node == node_before:
            continue
        for step in range(shorter.steps):
            if value_before(step) != value(step):
                raise _NotSo(
                    f"{key} was {value_before(step)} at step {step} and is {value(step)} with trainer.max_steps = "
                    f"{config.trainer.max_steps}"
                )


def _scheduled(config: Config) -> dict[str, tuple[Any, Number]]:
    """Key -> its node and what it builds, of everything that depends on the step."""
    found: dict[str, tuple[Any, Number]] = {
        "lr_scale": (config.lr_scale, build_lr_scale(config)),
        "clips.frames": (config.clips.frames, build_clip_frames(config)),
    }
    found |= {f"schedule.{name}": (config.schedule[name], s) for name, s in build_schedules(config).items()}
    found |= {f"loss.{name}": (config.loss[name], w) for name, w in build_weights(config).items()}
    return found


def take_over(run: Run, found: Sequence[Shorter], model: SceneModel) -> dict[str, Any] | None:
    """Puts what the first usable of some shorter runs has made into a run's folder, its last checkpoint at the end.

    A kill in between leaves no checkpoint, so the next start does it again; from the checkpoint on the run needs the
    shorter one no more.

    Args:
        run: the longer run, whose data are known.
        found: as `find` gives them.
        model: of the run.

    Returns:
        The checkpoint to resume from; None where no shorter run can be used, which a line for each has said.
    """
    known = [str(name) for _, name in trust.targets(run.job.raw)]
    for shorter in found:
        places = shorter.folder / "checkpoints"
        try:
            last = checkpoints.load(places / run.last.name, known=known)
            _check(last, shorter, run, model)
            best = checkpoints.load(places / run.best.name, known=known) if (places / run.best.name).exists() else None
        except (_NotSo, UserError) as why:
            console.say(_told(shorter, why))
            continue
        _put(run, shorter, last, best, model)
        return checkpoints.load(run.last, known=known)
    console.say(ANEW)
    return None


def _put(
    run: Run, shorter: Shorter, last: Mapping[str, Any], best: Mapping[str, Any] | None, model: SceneModel
) -> None:
    step, training = last["step"], last["training"]
    console.say(f"going on from step {step} of {shorter.folder}, which stays as it is")
    about = {"folder": str(shorter.folder), "step": step}
    _copy_curves(shorter.folder / run.curves_file.name, run.curves_file, step, run.job.config)
    if best is not None:
        checkpoints.save(run.best, _as_own(best, run.job, model))
    kept = {"foreground_share": training.get("record", {}).get("foreground_share"), "continues": about}
    early = bool(training["ended"]) and step < shorter.steps  # a callback has ended it, as it would end the longer run
    own = {**training, "ended": early, "record": kept}
    checkpoints.save(run.last, {**_as_own(last, run.job, model), "training": own})


def _check(last: Mapping[str, Any], shorter: Shorter, run: Run, model: SceneModel) -> None:
    """Looks whether a checkpoint is what its run's end left, and fits.

    Raises:
        _NotSo: it is not.
    """
    training = last["training"]
    if training is None or fingerprint(last["config"]) != fingerprint(shorter.raw):
        raise _NotSo("its checkpoint is that of another run")
    if training["data_fingerprint"] != run.record["data_fingerprint"]:
        raise _NotSo("it was trained on other data")
    if last["step"] < shorter.steps and not training["ended"]:
        raise _NotSo(f"its checkpoint is of step {last['step']}")
    sizes = {name: tuple(value.shape) for name, value in last["inference"]["weights"].items()}
    misfit = initial.misfit(sizes, {name: tuple(value.shape) for name, value in model.state_dict().items()})
    if misfit is not None:
        raise _NotSo(f"its weights were made by other code: {misfit}")
    if training["callbacks"] and last["step"] >= shorter.steps:
        names = ", ".join(sorted(key.partition("{")[0] for key in training["callbacks"]))
        raise _NotSo(f"callbacks with a state of their own ({names}) may have ended the longer run at that step")


def _as_own(content: Mapping[str, Any], job: Job, model: SceneModel) -> dict[str, Any]:
    """A checkpoint as the run of another job would have stored it."""
    schedule = in_evaluation(build_schedules(job.config), model, content["step"])
    inference = {**content["inference"], "model": job.config.model, "schedule": schedule}
    own = {"inference": inference, "config": job.raw, "choices": job.choices}
    return {**{key: value for key, value in content.items() if key != "format"}, **own}


def _copy_curves(source: Path, target: Path, step: int, config: Config) -> None:
    """Copies a table of curves up to a step, without a validation that was only due at the shorter run's end."""
    if not source.is_file():
        return
    with open(source, "rb") as original, replacing(target) as copy:
        shutil.copyfileobj(original, copy)
    interval = config.trainer.validation_interval
    if interval is not None and step % interval != 0:
        Curves(target, step).forget(step, "val/")
