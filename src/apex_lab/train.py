"""Trains a model on a data set and evaluates it.

python -m apex_lab.train scale=cpu
python -m apex_lab.train +ablation=no_entropy seed=0,1,2,3 scale=cpu -m
"""

from __future__ import annotations

import traceback
from typing import Any

import lightning as L
import torch
from lightning.pytorch.loggers import Logger

from apex_lab import evaluation
from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import read_json
from apex_lab.base.interrupts import Deferred, Interrupted, deferring
from apex_lab.base.validation import one_line
from apex_lab.config import command_line as cli
from apex_lab.config.schema import (
    Job,
    build_lr_scale,
    build_model,
    build_optimizer,
    build_schedules,
    build_weights,
    check_job,
    components,
)
from apex_lab.config.schema import device as device_of
from apex_lab.runs import checkpoints
from apex_lab.runs.folder import Run, fingerprint, group_name
from apex_lab.scene import SceneModel, schedule_at
from apex_lab.training import callbacks, estimate
from apex_lab.training.learner import Learner, Stretches
from apex_lab.training.loggers import Curves, Wandb


def main() -> None:
    """Entry point: `python -m apex_lab.train`."""
    cli.launch("train", check_job, train, title)


def title(job: Job) -> str:
    """A run in a few words."""
    return f"{group_name(job)}, seed {job.config.seed}"


def train(job: Job) -> None:
    """Brings a run to its end: says so if it is finished, goes on where it stopped, or starts it.

    Raises:
        UserError: the run cannot be done as asked; one sentence.
    """
    with Run(job) as run:
        if run.finished:
            console.say(f"finished already: {run.folder}")
            _show(run)
            return
        device = device_of(job.config.trainer.accelerator)
        run.start(cli.command_line(), device)
        with console.log_to(run.folder / "log.txt"):
            try:
                _train(run, device)
            except BaseException as error:
                run.fail(_reason(error))
                console.note(traceback.format_exc())
                raise
            run.finish()
            _show(run)


def _reason(error: BaseException) -> str:
    if isinstance(error, UserError):
        return str(error)
    return f"stopped by {error}" if isinstance(error, Interrupted) else f"{type(error).__name__}: {one_line(error)}"


def _train(run: Run, device: torch.device) -> None:
    config = run.job.config
    checkpoint = _checkpoint(run)
    if checkpoint is not None:
        _compare_configuration(run, checkpoint)
    console.say(f"{title(run.job)} on {device.type}: {run.folder}")
    model = build_model(config)
    if model.needs_training and checkpoint is None and device.type == "cpu":
        told = estimate.warning(config, model)
        if told is not None:
            console.warn(told)
    data = components.build(config.data, "data")
    data.prepare_data()
    data.setup("fit")
    _compare_data(run, data.fingerprint, checkpoint)
    if checkpoint is None:
        model.initialise(torch.as_tensor(data.train_median()))
    else:
        _load_weights(run, model, checkpoint["weights"])
        console.say(f"going on from step {checkpoint['step']}")
    loggers: list[Logger] = []
    if model.needs_training:
        loggers = _loggers(run, checkpoint["step"] if checkpoint else 0)
        _fit(run, model, data, checkpoint, loggers, device)
    else:
        checkpoints.save(run.last, _untrained(run, model))
    scores = _evaluate(run, model, data, device)
    for logger in loggers:
        if isinstance(logger, Wandb):
            logger.end(scores)


def _fit(
    run: Run,
    model: SceneModel,
    data: Any,
    checkpoint: dict[str, Any] | None,
    loggers: list[Logger],
    device: torch.device,
) -> None:
    """All weight updates that are left."""
    config, settings = run.job.config, run.job.config.trainer
    start = checkpoint["step"] if checkpoint else 0
    if start >= settings.max_steps:
        return
    training = checkpoint["training"] if checkpoint else None

    def optimizer(parameters: list[torch.nn.Parameter]) -> torch.optim.Optimizer:
        built = build_optimizer(config, parameters)
        if training is not None:
            built.load_state_dict(training["optimizer"])
        return built

    learner = Learner(
        model,
        optimizer,
        build_schedules(config),
        build_weights(config),
        seed=config.seed,
        gradient_clip_norm=settings.gradient_clip_norm,
        log_interval=settings.log_interval,
        step=start,
        lr_scale=build_lr_scale(config),
    )
    if settings.compile:
        model.compile()
    data.start_step, data.max_steps = start, settings.max_steps
    with deferring() as deferred:
        _trainer(run, start, training, deferred, loggers, device).fit(
            learner,
            Stretches(data.train_dataloader(), learner, settings.validation_interval),
            data.loader("val", settings.validation_videos) if settings.validation_interval is not None else None,
        )


def _trainer(
    run: Run,
    start: int,
    training: dict[str, Any] | None,
    deferred: Deferred,
    loggers: list[Logger],
    device: torch.device,
) -> L.Trainer:
    settings = run.job.config.trainer
    return L.Trainer(
        accelerator="gpu" if device.type == "cuda" else "cpu",
        devices=1,
        precision="bf16-mixed" if settings.precision == "bf16-mixed" else "32-true",
        max_epochs=-1,
        max_steps=settings.max_steps - start,
        num_sanity_val_steps=0,
        logger=loggers,
        callbacks=_callbacks(run, training, deferred),
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        inference_mode=False,
        default_root_dir=run.folder,
    )


def _evaluate(run: Run, model: SceneModel, data: Any, device: torch.device) -> dict[str, float]:
    """Scores and pictures of the final weights, in the run's folder; the paper's four scores."""
    config = run.job.config
    asked = config.evaluation
    schedule = schedule_at({n: s(config.trainer.max_steps) for n, s in build_schedules(config).items()}, device)
    data.setup("test")
    scored, _ = evaluation.evaluate(
        evaluation.Asked(
            folder=run.folder,
            split=asked.split,
            about={"seed": config.seed, "data_fingerprint": data.fingerprint},
            settings=asked.model_dump(),
            beside={"validation_foreground_share": run.record.get("foreground_share")},
            pictures=asked.pictures,
            view=run.view_folder,
            curves=run.curves_file,
        ),
        evaluation.Predictor(model, schedule, device, config.trainer.precision),
        data.loader(asked.split, asked.videos),
    )
    return {f"{asked.split}/{key}": scored["total"][key] for key in evaluation.COLUMNS}


def _show(run: Run) -> None:
    """The rows of scores and the pictures' paths."""
    for split, scored in read_json(run.metrics_file)["splits"].items():
        console.say(evaluation.summary(split, scored["total"]))
    pictures = [path for path in run.view_folder.glob("*") if path.is_file()]
    for path in sorted(pictures, key=lambda path: (path.stem != "film_strip", path.name)):
        console.say(str(path))


def _checkpoint(run: Run) -> dict[str, Any] | None:
    """What to go on from; a damaged last checkpoint is told, and the one before it taken."""
    paths = [path for path in (run.last, checkpoints.previous(run.last)) if path.exists()]
    for path in paths:
        try:
            return checkpoints.load(path)
        except UserError as error:
            console.warn(str(error))
    if paths:
        raise UserError(
            f"No whole checkpoint is left in {run.last.parent}: remove {run.folder} to start this run anew."
        )
    return None


def _compare_configuration(run: Run, checkpoint: dict[str, Any]) -> None:
    """Refuses to go on from the weights of another configuration, which may have the very same shapes."""
    if fingerprint(checkpoint["config"]) != fingerprint(run.job.raw):
        other = " ".join(f"{key}={word}" for key, word in checkpoint["choices"].items() if key in cli.CHOICES)
        raise UserError(
            f"The checkpoint in {run.folder} was made with another configuration ({other or 'no choices stored'}): "
            "put the run's own checkpoint back, or remove the folder to start anew."
        )


def _load_weights(run: Run, model: SceneModel, weights: dict[str, torch.Tensor]) -> None:
    try:
        model.load_state_dict(weights)
    except RuntimeError as error:
        raise UserError(
            f"The checkpoint in {run.folder} was made by other code ({one_line(error)}): "
            "go back to that code, or remove the folder to start anew."
        ) from error


def _untrained(run: Run, model: SceneModel) -> dict[str, Any]:
    job = run.job
    return {"step": 0, "weights": model.state_dict(), "config": job.raw, "choices": job.choices, "training": None}


def _compare_data(run: Run, found: str, checkpoint: dict[str, Any] | None) -> None:
    """Refuses to go on with other data than the run began with."""
    stored = run.record["data_fingerprint"]
    if checkpoint is not None and stored is not None and stored != found:
        raise UserError(
            f"{run.folder} was begun with other data (fingerprint {stored[:8]}, now {found[:8]}): "
            "bring the data back, or remove the run folder to start anew."
        )
    run.update(data_fingerprint=found)


def _loggers(run: Run, step: int) -> list[Logger]:
    config = run.job.config
    built = [
        components.build(
            node, f"logger.{name}", **({"run": run} if components.takes(node, f"logger.{name}", "run") else {})
        )
        for name, node in config.logger.items()
    ]
    return [Curves(run.curves_file, step), *built]


def _callbacks(run: Run, training: dict[str, Any] | None, deferred: Deferred) -> list[L.Callback]:
    config = run.job.config
    settings = config.trainer
    keep = callbacks.Checkpoints(
        run,
        settings.checkpoint_interval,
        settings.validation_interval,
        settings.max_steps,
        settings.monitor,
        settings.monitor_mode,
        deferred,
        training,
    )
    return [keep, *(components.build(node, f"callbacks.{name}") for name, node in config.callbacks.items())]


if __name__ == "__main__":
    main()
