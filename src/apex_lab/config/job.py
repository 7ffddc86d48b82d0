"""A composed configuration, checked before anything starts."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from apex_lab.base.errors import UserError
from apex_lab.base.validation import validate
from apex_lab.config import ablations, components, consistency, limits
from apex_lab.config.composition import Composed, conf_dir
from apex_lab.config.schema import Config


@dataclass(frozen=True)
class Job:
    """One checked configuration.

    Attributes:
        config: the typed root.
        raw: the same as plain containers with all interpolations resolved; stored and fingerprinted.
        choices: group -> the word chosen for it ("model" -> "apex"); a group that was not chosen is missing.
        overrides: the words on the command line, without sweeps.
    """

    config: Config
    raw: dict[str, Any]
    choices: dict[str, str] = field(default_factory=dict)
    overrides: tuple[str, ...] = ()


def check_job(
    raw: dict[str, Any],
    choices: Mapping[str, str],
    overrides: Sequence[str] = (),
    needs_recipe: bool = True,
    to_train: bool = True,
) -> Job:
    """Checks everything that can be known before work starts; the first fault is reported in one sentence.

    Types and bounds of every key, components against their constructors' signatures, and whether model, schedules and
    loss belong together. Components are built once (none reads data or starts anything when built).

    Args:
        raw: plain containers, all interpolations resolved.
        choices: group -> word.
        overrides: the words on the command line.
        needs_recipe: refuse a model that learns without a recipe among the choices.
        to_train: False for a configuration that only describes trained weights: nothing is built then, and what
            training alone needs (recipe, optimiser, schedules, devices) is not compared.

    Raises:
        UserError: the sentence.
    """
    raw = {key: value for key, value in raw.items() if key != "hydra"}
    if "sweep" in raw:
        raise UserError(f"+sweep={choices.get('sweep', '...')} lists several jobs: add -m to run them.")
    groups = [folder.name for folder in conf_dir().iterdir() if folder.is_dir()]
    config = validate(Config, raw, "", also_known=groups)
    assert isinstance(config, Config)
    refuse_missing(raw)
    if to_train:
        ablations.check(raw, choices, conf_dir())
        ablations.check_original(choices)
    if needs_recipe and to_train:
        _check_recipe(config, choices)
    try:
        consistency.check_parts(config)
    except UserError as error:
        ablations.explain(str(error), choices, conf_dir())
        explain_merged(str(error), overrides)
        raise
    if not to_train:
        return Job(config, raw, dict(choices), tuple(overrides))
    try:
        with limits.bounded():
            consistency.check_together(config)
    except UserError as error:
        ablations.explain(str(error), choices, conf_dir())
        raise
    limits.refuse_large_batches(config.model_dump(), consistency.longest_clip(config))
    consistency.check_splits(config)
    consistency.check_cuda_graph(config.trainer)
    return Job(config, raw, dict(choices), tuple(overrides))


def reseeded(job: Job, made: Composed) -> Job:
    """The job of another seed of a configuration that `check_job` has passed.

    Raises:
        UserError: it is no seed.
    """
    config = validate(Config, made.raw, "")
    assert isinstance(config, Config)
    return Job(config, made.raw, job.choices, made.words)


def refuse_missing(raw: Mapping[str, Any], prefix: str = "") -> None:
    """Looks for values that a file leaves to the command line.

    Raises:
        UserError: one was not given.
    """
    for key, value in raw.items():
        if value == "???":
            raise UserError(f"{prefix}{key} is missing: write {prefix}{key}=...")
        if isinstance(value, Mapping):
            refuse_missing(value, f"{prefix}{key}.")


def explain_merged(sentence: str, overrides: Sequence[str]) -> None:
    """A dictionary on the command line is merged into the one in the files, and so is another `_target_`; keys can be
    unknown then that nobody typed.

    Args:
        sentence: what a check has said.
        overrides: the words on the command line.

    Raises:
        UserError: that is what has happened.
    """
    typed = {word.lstrip("+").partition("=")[0] for word in overrides}
    for word in overrides:
        key, _, value = word.lstrip("+").partition("=")
        part = key.removesuffix("._target_")
        unknown = re.match(rf"Unknown key {re.escape(part)}\.(\w+)", sentence)
        if unknown is None:
            continue
        name, rest = f"{part}.{unknown.group(1)}", f"to replace all of it, write ~{part} '+{part}={{...}}'."
        if part != key and name not in typed:
            raise UserError(f"{name} is set by the files that were chosen, and {value} does not take it: {rest}")
        if part == key and value.startswith("{") and unknown.group(1) not in value:
            raise UserError(f"{key}={{...}} is merged into what the files set there, {name} among it: {rest}")


def _check_recipe(config: Config, choices: Mapping[str, str]) -> None:
    """A model that learns needs a recipe for its scale; nothing is filled in by default."""
    target = components.target_of(config.model, "model")
    if "recipe" not in choices and getattr(target, "needs_training", False):
        model, scale = choices.get("model", "<model>"), choices.get("scale", "<scale>")
        there = sorted(path.stem for path in (conf_dir() / "recipe" / model).glob("*.yaml"))
        known = f": choose scale={' or '.join(there)}" if there else ""
        raise UserError(f"model={model} has no recipe conf/recipe/{model}/{scale}.yaml{known}.")
