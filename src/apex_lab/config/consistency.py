"""Whether the parts of a configuration belong together: components and arguments, model and loss, clips and videos."""

from __future__ import annotations

import inspect
import math
from collections.abc import Collection, Mapping
from typing import Any

from apex_lab.base.errors import UserError
from apex_lab.base.validation import did_you_mean, sentence, shown
from apex_lab.config import components, initial
from apex_lab.config.building import (
    build_clip_frames,
    build_lr_scale,
    build_model,
    build_optimizer,
    build_schedules,
    build_weights,
    device,
)
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
from apex_lab.config.schema import Config, TrainerPart
from apex_lab.data.source import VideoSource
from apex_lab.metrics.keys import VALIDATION_SCORES
from apex_lab.scene import SceneModel


def check_parts(config: Config) -> None:
    """Looks at every component and its arguments, without building any.

    Raises:
        UserError: one is unknown, of the wrong kind, or does not take what is given; one sentence.
    """
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


def check_together(config: Config) -> None:
    """Builds model, data, optimiser and schedules once, and compares what they need with what there is.

    Raises:
        UserError: a name or value that does not fit; one sentence.
    """
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
    _same_names("loss", weights, model.term_names, model.optional_terms)
    if model.needs_training:
        _check_early_stopping(config, model, source.labelled)
        named = [(name, p) for name, p in model.named_parameters() if p.requires_grad]
        check_update(lambda weights: build_optimizer(config, weights), named, (config.optimizer or {}).get("_target_"))
        _check_monitor("trainer.monitor", config.trainer.monitor, model)
        _check_clips(config)
        _check_ranks(config, model)


def check_splits(config: Config) -> None:
    """What validation and evaluation look at must not be empty.

    Raises:
        UserError: it is.
    """
    if config.trainer.validation_interval is not None and config.data.get("val") == 0:
        raise UserError(
            "data.val = 0 leaves nothing to validate on: raise it, or set trainer.validation_interval=null."
        )
    if config.data.get(config.evaluation.split) == 0:
        split = config.evaluation.split
        raise UserError(
            f"data.{split} = 0 leaves nothing to evaluate: raise it, or set evaluation.split to another split."
        )


def check_cuda_graph(trainer: TrainerPart) -> None:
    """A step can be captured on one GPU alone.

    Raises:
        UserError: there is none, or several.
    """
    kind = device(trainer.accelerator, "trainer.accelerator").type
    if trainer.cuda_graph and (kind != "cuda" or trainer.devices * trainer.num_nodes > 1):
        raise UserError(
            f"trainer.cuda_graph = true needs one CUDA device, and this is {trainer.devices} x {kind}: "
            "set trainer.cuda_graph=false."
        )


def longest_clip(config: Config) -> int | None:
    """Frames of the longest training clip; None: whole videos."""
    frames = build_clip_frames(config)
    lengths = [frames(step) for step in looked_at(config.trainer.max_steps)]
    return None if None in lengths else max(length for length in lengths if length is not None)


def needs_labels(monitor: str) -> bool:
    """Whether a value of validation is a score, which only videos with labels have."""
    return monitor.removeprefix("val/") in VALIDATION_SCORES


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
