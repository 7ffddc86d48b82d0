"""All weight updates that are left of a run, on every rank."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import lightning as L
import torch
import torch.distributed as dist
from lightning.pytorch.loggers import Logger
from lightning.pytorch.plugins.environments import LightningEnvironment
from lightning.pytorch.strategies import DDPStrategy

from apex_lab.base.errors import UserError
from apex_lab.base.interrupts import Interrupted
from apex_lab.base.memory import keep_freed_memory
from apex_lab.config.building import build_clip_frames, build_lr_scale, build_optimizer, build_schedules, build_weights
from apex_lab.config.schema import Config
from apex_lab.data import VideoSource, training_loader, whole_loader
from apex_lab.data.loaders import Loader
from apex_lab.data.loading import stop
from apex_lab.data.resident import Resident
from apex_lab.scene import SceneModel
from apex_lab.training.callbacks import LastValidation, Lockstep, not_restored
from apex_lab.training.learner import Learner
from apex_lab.training.ranks import Ranks
from apex_lab.training.update import Mode, WeightUpdate


def fit(
    config: Config,
    model: SceneModel,
    source: VideoSource,
    device: torch.device,
    step: int,
    training: Mapping[str, Any] | None,
    ranks: Ranks,
    callbacks: Sequence[L.Callback] = (),
    keep: L.Callback | None = None,
    loggers: Sequence[Logger] = (),
    folder: Path | None = None,
    deadline: float | None = None,
) -> bool:
    """Trains from a step to the end, unless it is asked to stop or time is up.

    Args:
        config: of the run.
        model: with the weights of that step.
        source: opened.
        device: kind of device.
        step: weight updates made.
        training: `training` entry of the checkpoint of that step; None at the start.
        ranks: which process this is.
        callbacks: of the configuration, the same on every rank.
        keep, loggers: what stores, of rank 0.
        folder: where callbacks may leave files, and the batch of an update that is not finite; the run's.
        deadline: when time is up, by `time.monotonic`, on rank 0; None for never.

    Returns:
        Whether training came to its end.

    Raises:
        Interrupted: a process of this training was asked to stop; the step is stored.
    """
    settings = config.trainer
    keep_freed_memory()
    update = WeightUpdate(
        model,
        build_schedules(config),
        build_weights(config),
        build_lr_scale(config),
        settings.gradient_clip_norm,
        config.seed,
        settings.precision,
        step,
        mode_of(config, device),
    )
    optimizer = partial(_optimizer, config, training)
    learner = Learner(update, optimizer, settings.log_interval, ranks.rank, ranks.world, folder)
    every = [
        LastValidation(settings.max_steps),
        *callbacks,
        Lockstep(
            training.get("callbacks", {}) if training else {},
            settings.checkpoint_interval,
            settings.max_steps,
            deadline,
        ),
        *([keep] if keep is not None else []),
    ]
    trainer = _trainer(config, update, device, ranks, every, loggers, folder)
    resume_at(trainer, step)
    batches = _batches(config, source, step, ranks, trainer.strategy.root_device)
    validation = whole_loader(
        source.sets["val"],
        config.evaluation.batch_size,
        settings.validation_videos,
        rank=ranks.rank,
        ranks=ranks.world,
    )
    try:
        trainer.fit(learner, batches, validation if settings.validation_interval is not None else None)
    finally:
        if not isinstance(batches, Resident):
            stop(batches)
    if ranks.world > 1 and dist.is_initialized():
        dist.destroy_process_group()
    if learner.stop:
        raise Interrupted(learner.stop)
    return learner.step >= settings.max_steps or trainer.should_stop


def _optimizer(
    config: Config, training: Mapping[str, Any] | None, parameters: list[tuple[str, torch.nn.Parameter]]
) -> torch.optim.Optimizer:
    """The optimiser of these parameters, in the state of the checkpoint that `training` comes from."""
    built = build_optimizer(config, parameters)
    if training is not None:
        try:
            built.load_state_dict(training["optimizer"])
        except Exception as error:
            raise UserError(not_restored("the state of the optimizer", error)) from error
    return built


def _batches(config: Config, source: VideoSource, step: int, ranks: Ranks, device: torch.device) -> Loader | Resident:
    """This rank's batches of training videos from a step on."""
    return training_loader(
        source,
        config.clips.batch_size,
        config.seed,
        step,
        config.trainer.max_steps,
        build_clip_frames(config),
        ranks.rank,
        ranks.world,
        config.clips.starts,
        device,
        config.clips.on_device,
    )


def _trainer(
    config: Config,
    update: WeightUpdate,
    device: torch.device,
    ranks: Ranks,
    callbacks: Sequence[L.Callback],
    loggers: Sequence[Logger],
    folder: Path | None,
) -> L.Trainer:
    """Lightning's trainer, with everything off that this package does itself."""
    settings = config.trainer
    trainer = L.Trainer(
        accelerator="gpu" if device.type == "cuda" else "cpu",
        devices=settings.devices,
        num_nodes=settings.num_nodes,
        strategy=DDPStrategy(find_unused_parameters=_some_unused(config, update)) if ranks.world > 1 else "auto",
        # Lightning's own precision: validation runs in it too; the step opens the same for itself
        precision="bf16-mixed" if settings.precision == "bf16-mixed" else "32-true",
        # this package starts all processes itself, or torchrun does; so no other cluster's variables count
        plugins=[LightningEnvironment()],
        max_epochs=1,
        max_steps=settings.max_steps,
        val_check_interval=settings.validation_interval,
        check_val_every_n_epoch=None if settings.validation_interval is not None else 1,
        limit_val_batches=None if settings.validation_interval is not None else 0,
        num_sanity_val_steps=0,
        log_every_n_steps=1,
        logger=list(loggers),
        callbacks=list(callbacks),
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        inference_mode=False,
        default_root_dir=folder,
    )
    _ours_alone(trainer)
    return trainer


def _ours_alone(trainer: L.Trainer) -> None:
    """Leaves signals, and the choice of what a run resumes from, to this package.

    Lightning takes SIGTERM for itself, and inside a Slurm job it loads an `hpc_ckpt_*.ckpt` that lies in the folder,
    whatever its plugins are; it has no switch for either.
    """
    for owner, name, instead in (
        (trainer._signal_connector, "register_signal_handlers", lambda: None),
        (trainer._checkpoint_connector, "_select_ckpt_path", lambda *_, **__: None),
    ):
        assert callable(getattr(owner, name))  # else this Lightning is another one: see how it does these things
        setattr(owner, name, instead)


def _some_unused(config: Config, update: WeightUpdate) -> bool:
    """Whether a step may leave parameters without gradients: a term without weight, clips too short for propagation."""
    weights, steps = update.weights.schedules, range(update.step, config.trainer.max_steps)
    weightless = len(weights) < len(update.terms) or any(w(step) == 0 for w in weights.values() for step in steps)
    return weightless or config.clips.frames is not None


def resume_at(trainer: L.Trainer, step: int) -> None:
    """Sets Lightning's counters of batches and updates, so that its steps and validations are those of the run."""
    loop = trainer.fit_loop.epoch_loop
    loop._batches_that_stepped = step  # the step of what callbacks log
    batches, updates = loop.batch_progress.total, loop.manual_optimization.optim_step_progress.total
    batches.ready = batches.completed = step
    updates.ready = updates.completed = step


def mode_of(config: Config, device: torch.device) -> Mode:
    """How weight updates are carried out."""
    if config.trainer.cuda_graph and device.type == "cuda":
        return "compiled cuda graph" if config.trainer.compile else "cuda graph"
    return "compiled" if config.trainer.compile else "eager"
