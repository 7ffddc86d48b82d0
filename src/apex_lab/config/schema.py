"""What a configuration may hold, and how a composed one is checked before anything starts."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, model_validator

from apex_lab.base.errors import UserError
from apex_lab.base.validation import PathText, did_you_mean, sentence, shown, validate
from apex_lab.config import ablations, components, initial, limits
from apex_lab.config.checks import (
    RATE,
    check_range,
    check_update,
    looked_at,
    refuse_checkpoints,
    refuse_missing_package,
    refuse_others,
)
from apex_lab.config.components import is_node
from apex_lab.config.composition import Composed, conf_dir
from apex_lab.data.source import VideoSource
from apex_lab.metrics.keys import VALIDATION_SCORES
from apex_lab.scene import SceneModel
from apex_lab.training.schedules import Constant


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class TrainerPart(_Part):
    """Length and device of training; `steps` are weight updates.

    A key that was added later has the default that stands in `apex_lab.config.upgrades.ADDED` too.
    """

    accelerator: Literal["auto", "cpu", "gpu"]
    devices: int = Field(default=1, ge=1)
    num_nodes: int = Field(default=1, ge=1)
    precision: Literal[32, "bf16-mixed"]
    compile: bool
    cuda_graph: bool = False
    max_steps: int = Field(ge=1)
    max_minutes: float | None = Field(default=None, gt=0)
    gradient_clip_norm: float | None = Field(gt=0)
    log_interval: int = Field(ge=1)
    validation_interval: int | None = Field(ge=1)
    validation_videos: int | None = Field(ge=1)
    checkpoint_interval: int = Field(ge=1)
    monitor: str = Field(pattern="^val/.+")
    monitor_mode: Literal["max", "min"]


class ClipsPart(_Part):
    """What a training step sees.

    Attributes:
        batch_size: clips of the global batch.
        frames: of a clip: null for whole videos, a number, or a schedule.
        starts: of clips that are shorter than their videos: `random`, or `disjoint`, pieces one after the other.
    """

    batch_size: int = Field(ge=1)
    frames: int | dict[str, Any] | None = None
    starts: Literal["random", "disjoint"] = "random"


class EvaluationPart(_Part):
    """What is measured and drawn at the end of training; `videos` null means the whole split."""

    split: Literal["train", "val", "test"]
    videos: int | None = Field(ge=1)
    pictures: int = Field(ge=0)
    batch_size: int = Field(default=4, ge=1)
    chunk: int | None = Field(default=None, ge=1)


class PathsPart(_Part):
    """Folders; relative ones are taken from where the command was started."""

    outputs: PathText
    data: PathText


class InitialPart(_Part):
    """Weights that training starts from; `apex_lab.config.initial` puts them in place of the word that was given."""

    checkpoint: str
    weights: str = Field(pattern=f"^{initial.DIGEST}$")


class Config(_Part):
    """The root of what `python -m apex_lab.train` composes; components are checked by `apex_lab.config.components`."""

    seed: int = Field(ge=0, lt=2**32)
    init_from: InitialPart | None = None
    model: dict[str, Any]
    optimizer: dict[str, Any] | None
    schedule: dict[str, dict[str, Any]]
    loss: dict[str, float | dict[str, Any]]
    lr_scale: float | dict[str, Any]
    data: dict[str, Any]
    clips: ClipsPart
    trainer: TrainerPart
    logger: dict[str, dict[str, Any]]
    callbacks: dict[str, dict[str, Any]]
    evaluation: EvaluationPart
    paths: PathsPart

    @model_validator(mode="after")
    def _components_named(self) -> Config:
        named: dict[str, Any] = {"model": self.model, "data": self.data}
        for group in ("schedule", "logger", "callbacks"):
            named.update({f"{group}.{name}": node for name, node in getattr(self, group).items()})
        if self.optimizer is not None:
            named["optimizer"] = self.optimizer
        for key, node in named.items():
            if not is_node(node):
                raise ValueError(f"{key} has no _target_: choose one of the shipped files or name the class to build")
        return self


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
        _check_components(config)
    except UserError as error:
        ablations.explain(str(error), choices, conf_dir())
        explain_merged(str(error), overrides)
        raise
    if not to_train:
        return Job(config, raw, dict(choices), tuple(overrides))
    try:
        with limits.bounded():
            _check_objective(config)
    except UserError as error:
        ablations.explain(str(error), choices, conf_dir())
        raise
    limits.refuse_large_batches(config.model_dump(), _longest_clip(config))
    _check_splits(config)
    _check_cuda_graph(config.trainer)
    return Job(config, raw, dict(choices), tuple(overrides))


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


def reseeded(job: Job, made: Composed) -> Job:
    """The job of another seed of a configuration that `check_job` has passed.

    Raises:
        UserError: it is no seed.
    """
    config = validate(Config, made.raw, "")
    assert isinstance(config, Config)
    return Job(config, made.raw, job.choices, made.words)


def device(accelerator: str, key: str = "accelerator") -> torch.device:
    """The device that a key of the configuration asks for.

    Args:
        accelerator: "auto", "cpu" or "gpu".
        key: its name, for the sentence.

    Raises:
        UserError: a GPU is asked for and there is none.
    """
    if accelerator == "gpu" and not torch.cuda.is_available():
        word = key.partition(".")[0]  # trainer=cpu, accelerator=cpu
        raise UserError(f"{key} = 'gpu', but PyTorch finds no CUDA device: use {word}=cpu or {word}=auto.")
    return torch.device("cuda" if accelerator != "cpu" and torch.cuda.is_available() else "cpu")


def build_model(config: Config) -> SceneModel:
    """The model with weights drawn from the seed alone; the caller's random state is left as it was.

    Raises:
        UserError: the constructor refuses its values, or it is no `SceneModel`.
    """
    with torch.random.fork_rng(devices=[]), limits.bounded():
        torch.manual_seed(config.seed)
        model = components.build(config.model, "model")
    if not isinstance(model, SceneModel):
        raise UserError(f"model._target_ = {config.model['_target_']!r} is not an apex_lab.scene.SceneModel.")
    return model


def build_optimizer(config: Config, parameters: Sequence[tuple[str, torch.nn.Parameter]]) -> torch.optim.Optimizer:
    """The optimiser over the given parameters, which it gets with their names.

    Raises:
        UserError: none is configured, or its constructor refuses its values.
    """
    if config.optimizer is None:
        raise UserError("optimizer = null, but the model has weights to train: choose one, such as torch.optim.Adam.")
    optimizer = components.build(config.optimizer, "optimizer", params=parameters)
    if not isinstance(optimizer, torch.optim.Optimizer):
        raise UserError(f"optimizer._target_ = {config.optimizer['_target_']!r} is not a torch.optim.Optimizer.")
    return optimizer


def build_schedules(config: Config) -> dict[str, Callable[[int], float]]:
    """Schedule name -> schedule, as the model's forward takes them."""
    return {name: components.build(node, f"schedule.{name}") for name, node in config.schedule.items()}


def build_weights(config: Config) -> dict[str, Callable[[int], float]]:
    """Loss term -> its weight as a schedule; a number is a weight that never changes."""
    return {name: _build_value(value, f"loss.{name}") for name, value in config.loss.items()}


def build_lr_scale(config: Config) -> Callable[[int], float]:
    """The factor of all learning rates, as a schedule."""
    return _build_value(config.lr_scale, "lr_scale")


def build_clip_frames(config: Config) -> Callable[[int], int | None]:
    """Frames of a training clip as a function of the step; None: whole videos."""
    frames = config.clips.frames
    if isinstance(frames, dict):
        schedule = components.build(frames, "clips.frames")
        return lambda step: int(schedule(step))
    return lambda step: frames


def _build_value(value: float | dict[str, Any], key: str) -> Callable[[int], float]:
    """A schedule; a number is one that never changes."""
    return components.build(value, key) if isinstance(value, dict) else Constant(value)


def _check_recipe(config: Config, choices: Mapping[str, str]) -> None:
    """A model that learns needs a recipe for its scale; nothing is filled in by default."""
    target = components.target_of(config.model, "model")
    if "recipe" not in choices and getattr(target, "needs_training", False):
        model, scale = choices.get("model", "<model>"), choices.get("scale", "<scale>")
        there = sorted(path.stem for path in (conf_dir() / "recipe" / model).glob("*.yaml"))
        known = f": choose scale={' or '.join(there)}" if there else ""
        raise UserError(f"model={model} has no recipe conf/recipe/{model}/{scale}.yaml{known}.")


def _check_cuda_graph(trainer: TrainerPart) -> None:
    """A step can be captured on one GPU alone."""
    kind = device(trainer.accelerator, "trainer.accelerator").type
    if trainer.cuda_graph and (kind != "cuda" or trainer.devices * trainer.num_nodes > 1):
        raise UserError(
            f"trainer.cuda_graph = true needs one CUDA device, and this is {trainer.devices} x {kind}: "
            "set trainer.cuda_graph=false."
        )


def _check_components(config: Config) -> None:
    components.check(config.model, "model")
    components.check(config.data, "data")
    if config.optimizer is not None:
        components.check(config.optimizer, "optimizer", supplied=["params"])
        rate = config.optimizer.get("lr")
        if isinstance(rate, int | float) and rate <= 0:
            raise UserError(f"optimizer.lr = {rate} is wrong: a learning rate is above 0.")
    numbers: dict[str, Any] = {f"schedule.{name}": node for name, node in config.schedule.items()}
    numbers |= {f"loss.{name}": value for name, value in config.loss.items()}
    for key, value in {**numbers, "lr_scale": config.lr_scale, "clips.frames": config.clips.frames}.items():
        if isinstance(value, dict):
            if not is_node(value):
                raise UserError(f"{key} = {shown(value)} is wrong: give a number or a schedule with a _target_.")
            components.check(value, key)
            if not inspect.isclass(components.target_of(value, key)):
                raise UserError(f"{key} is not a schedule: choose one of apex_lab.training.schedules.")
    for name, node in config.logger.items():
        components.check(node, f"logger.{name}", supplied=["run"])
        refuse_others(node, f"logger.{name}", "Logger")
        refuse_missing_package(node, f"logger.{name}")
    for name, node in config.callbacks.items():
        components.check(node, f"callbacks.{name}")
        refuse_others(node, f"callbacks.{name}", "Callback")
        refuse_checkpoints(node, f"callbacks.{name}")


def _check_objective(config: Config) -> None:
    """Builds model, optimiser and schedules, and compares their names."""
    model = build_model(config)
    if config.init_from is not None:
        if not model.needs_training:
            raise UserError("init_from is for training, and this model has nothing to train: leave it out.")
        initial.refuse_misfit(config.init_from, {n: tuple(v.shape) for n, v in model.state_dict().items()})
    if config.trainer.cuda_graph and not model.capturable:
        raise UserError(
            "trainer.cuda_graph = true repeats one step, and what this model does in a step follows its schedule: set "
            "trainer.cuda_graph=false."
        )
    schedules, weights = build_schedules(config), build_weights(config)
    source = components.build(config.data, "data")
    if not isinstance(source, VideoSource):
        raise UserError(f"data._target_ = {config.data['_target_']!r} is not an apex_lab.data.VideoSource.")
    if model.needs_labels and not source.labelled:
        raise UserError("The model needs labels, which the videos of this data set have not: choose another model.")
    for name, node in config.callbacks.items():
        components.build(node, f"callbacks.{name}")
    values = {f"schedule.{name}": value for name, value in schedules.items()}
    values |= {f"loss.{name}": value for name, value in weights.items()}
    values["lr_scale"] = build_lr_scale(config)
    for key, value in values.items():
        if not callable(value):
            raise UserError(f"{key} is not a schedule: choose one of apex_lab.training.schedules.")
    ranges = dict.fromkeys(values, (0.0, math.inf)) | dict.fromkeys(
        (f"schedule.{name}" for name in schedules), (-math.inf, math.inf)
    )
    ranges["lr_scale"] = (0.0, RATE)
    ranges |= {f"schedule.{name}": within for name, within in model.schedule_ranges.items()}
    for key, value in values.items():
        check_range(key, value, ranges[key], config.trainer.max_steps)
    _same_names("schedule", schedules, model.schedule_ranges, model.optional_schedules)
    _same_names("loss", weights, model.term_names)
    if model.needs_training:
        _check_early_stopping(config, model, source.labelled)
        named = [(name, p) for name, p in model.named_parameters() if p.requires_grad]
        check_update(lambda weights: build_optimizer(config, weights), named, (config.optimizer or {}).get("_target_"))
        _check_monitor("trainer.monitor", config.trainer.monitor, model)
        _check_clips(config)
        _check_ranks(config, model)


def _longest_clip(config: Config) -> int | None:
    """Frames of the longest training clip; None: whole videos."""
    frames = build_clip_frames(config)
    lengths = [frames(step) for step in looked_at(config.trainer.max_steps)]
    return None if None in lengths else max(length for length in lengths if length is not None)


def _check_ranks(config: Config, model: SceneModel) -> None:
    """Several processes must be able to give the result of one."""
    ranks = config.trainer.devices * config.trainer.num_nodes
    if ranks == 1:
        return
    if config.clips.batch_size % ranks:
        raise UserError(
            f"clips.batch_size = {config.clips.batch_size} is the global batch, which {ranks} processes "
            "(trainer.devices x trainer.num_nodes) cannot share equally: choose a multiple."
        )
    if model.batch_statistics:
        raise UserError(
            f"trainer.devices x trainer.num_nodes = {ranks}, but this model normalises over the batch, or draws "
            "for it, which shares of a batch cannot do: set both to 1."
        )
    counts = [count for count in (config.data.get("val"), config.trainer.validation_videos) if isinstance(count, int)]
    if config.trainer.validation_interval is not None and counts and min(counts) < ranks:
        raise UserError(
            f"{min(counts)} validation videos (data.val, trainer.validation_videos) are too few for {ranks} processes: "
            "raise them, or set trainer.validation_interval=null."
        )


def _check_clips(config: Config) -> None:
    """Clips of at least a frame, and not longer than videos."""
    frames, longest = build_clip_frames(config), config.data.get("frames")
    last = config.trainer.max_steps
    every = range(last) if last <= 100_000 else looked_at(last - 1)
    for step in every if isinstance(config.clips.frames, dict) else (0,):
        wanted = frames(step)
        if wanted is None:
            continue
        if wanted < 1:
            raise UserError(f"clips.frames is {wanted} at step {step}: a clip has at least one frame.")
        if isinstance(longest, int) and wanted > longest:
            raise UserError(f"clips.frames is {wanted} at step {step}, but videos have data.frames = {longest} frames.")


def _check_monitor(key: str, monitor: object, model: SceneModel) -> None:
    """The score that decides on best.ckpt, or on stopping early, must be one that validation gives."""
    known = [f"val/{name}" for name in (*VALIDATION_SCORES, "foreground_share", "loss", *model.term_names)]
    if monitor not in known:
        guess = did_you_mean(str(monitor), known)
        raise UserError(sentence(f"{key} = '{monitor}' is none of {', '.join(known)}{guess}"))


def needs_labels(monitor: str) -> bool:
    """Whether a value of validation is a score, which only videos with labels have."""
    return monitor.removeprefix("val/") in VALIDATION_SCORES


def _check_early_stopping(config: Config, model: SceneModel, labelled: bool) -> None:
    """Lightning's early stopping finds out only at the first validation that there is no such score."""
    for name, node in config.callbacks.items():
        if str(node["_target_"]).endswith(".EarlyStopping") and "monitor" in node:
            _check_monitor(f"callbacks.{name}.monitor", node["monitor"], model)
            if not labelled and needs_labels(node["monitor"]):
                raise UserError(
                    f"callbacks.{name}.monitor = {node['monitor']} needs labels, and these videos have none: "
                    "set it to val/loss, and its mode to min."
                )
            if config.trainer.validation_interval is None:
                raise UserError(
                    f"callbacks.{name} looks at validation's scores: set trainer.validation_interval, or leave it out."
                )


def _check_splits(config: Config) -> None:
    """What validation and evaluation look at must not be empty."""
    if config.trainer.validation_interval is not None and config.data.get("val") == 0:
        raise UserError(
            "data.val = 0 leaves nothing to validate on: raise it, or set trainer.validation_interval=null."
        )
    if config.data.get(config.evaluation.split) == 0:
        split = config.evaluation.split
        raise UserError(
            f"data.{split} = 0 leaves nothing to evaluate: raise it, or set evaluation.split to another split."
        )


def _same_names(key: str, given: Mapping[str, object], wanted: Collection[str], optional: Collection[str] = ()) -> None:
    for name in given:
        if name not in wanted:
            raise UserError(
                sentence(f"Unknown key {key}.{name}: the model has {_listed(wanted)}{did_you_mean(name, wanted)}")
            )
    for name in wanted:
        if name not in given and name not in optional:
            raise UserError(f"{key}.{name} is missing: the model needs {_listed(wanted)}.")


def _listed(names: Collection[str]) -> str:
    return ", ".join(names) if names else "none"
