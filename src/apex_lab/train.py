"""Trains a model on a data set and evaluates it.

python -m apex_lab.train scale=cpu
python -m apex_lab.train +ablation=no_entropy seed=0,1,2,3 scale=cpu -m
"""

from __future__ import annotations

import traceback
from collections.abc import Sequence
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
from apex_lab.config import components, trust
from apex_lab.config.schema import Job, build_model, build_schedules, check_job, reseeded
from apex_lab.config.schema import device as device_of
from apex_lab.config.upgrades import fingerprint
from apex_lab.data import VideoSource, whole_loader
from apex_lab.inference.predictor import Predictor
from apex_lab.inference.sizes import fitted
from apex_lab.runs import checkpoints
from apex_lab.runs.folder import Outcome, Run, group_name, run_folder
from apex_lab.runs.state import beating, read_state
from apex_lab.scene import SceneModel, Statistics, schedule_at
from apex_lab.training import callbacks as own_callbacks
from apex_lab.training import estimate, ranks, worker
from apex_lab.training.callbacks import Pruned
from apex_lab.training.fit import fit
from apex_lab.training.learner import Diverged
from apex_lab.training.loggers import Curves, Wandb


def main() -> None:
    """Entry point: `python -m apex_lab.train`."""
    cli.launch(
        cli.Command("train", check_job, train, title, known=lambda job: read_state(run_folder(job)), reseeded=reseeded)
    )


def title(job: Job) -> str:
    """A run in a few words."""
    return f"{group_name(job)}, seed {job.config.seed}"


def train(job: Job, callbacks: Sequence[L.Callback] = (), command: str | None = None) -> None:
    """Starts a run, resumes it where it stopped, or shows the scores of a finished one.

    Args:
        job: the run.
        callbacks: further ones, on rank 0; they hear of a validation when its checkpoint is stored.
        command: what the run's record names as its command; None: this process's own.

    Raises:
        Pruned: a callback ended the run.
        UserError: the run cannot be done as asked; one sentence.
    """
    outside = ranks.given()
    if outside is not None and outside.rank > 0:
        worker.train_along(ranks.wait_for(ranks.job_file(run_folder(job))), outside)
        return
    with Run(job) as run:
        if run.finished:
            console.say(f"finished already: {run.folder}")
            _show(run)
            return
        device = device_of(job.config.trainer.accelerator)
        run.start(command or cli.command_line(), device)
        with beating(run.folder), console.log_to(run.folder / "log.txt"):
            try:
                _train(run, device, callbacks)
            except BaseException as error:
                run.fail(*_reason(error))
                console.note(traceback.format_exc())
                raise
            run.finish()
            _show(run)


def _reason(error: BaseException) -> tuple[str, Outcome]:
    if isinstance(error, Interrupted):
        return f"stopped by {error}", "interrupted"
    if isinstance(error, Pruned):
        return str(error), "pruned"
    if isinstance(error, UserError):
        return str(error), "diverged" if isinstance(error, Diverged) else "failed"
    return f"{type(error).__name__}: {one_line(error)}", "failed"


def _train(run: Run, device: torch.device, callbacks: Sequence[L.Callback]) -> None:
    config = run.job.config
    checkpoint = _checkpoint(run)
    if checkpoint is not None:
        _compare_configuration(run, checkpoint)
    console.say(f"{title(run.job)} on {device.type}: {run.folder}")
    model = build_model(config)
    if model.needs_training and checkpoint is None and device.type == "cpu":
        warning = estimate.warning(config, model)
        if warning is not None:
            console.warn(warning)
    source: VideoSource = components.build(config.data, "data")
    source.prepare()
    source.open()
    _compare_data(run, source.fingerprint, checkpoint)
    if checkpoint is None:
        model.initialise(Statistics(lambda: _median(source, model)))
    else:
        _load_weights(run, model, checkpoint["inference"]["weights"])
        console.say(f"resuming from step {checkpoint['step']}")
    loggers: list[Logger] = []
    if model.needs_training:
        loggers = _loggers(run, checkpoint["step"] if checkpoint else 0)
        _fit(run, model, source, checkpoint, loggers, device, callbacks)
    else:
        checkpoints.save(run.last, _untrained(run, model))
    scores = _evaluate(run, model, source, device)
    for logger in loggers:
        if isinstance(logger, Wandb):
            logger.end(scores)


def _median(source: VideoSource, model: SceneModel) -> torch.Tensor:
    """The training set's median image at the model's input size."""
    return fitted(source.sets["train"].median()[None, None], model.input_size)[0, 0]


def _fit(
    run: Run,
    model: SceneModel,
    source: VideoSource,
    checkpoint: dict[str, Any] | None,
    loggers: list[Logger],
    device: torch.device,
    further: Sequence[L.Callback],
) -> None:
    """All weight updates that are left."""
    config, settings = run.job.config, run.job.config.trainer
    start = checkpoint["step"] if checkpoint else 0
    if start >= settings.max_steps:
        return
    training = checkpoint["training"] if checkpoint else None
    job = {
        "config": config.model_dump(),
        "weights": model.state_dict(),
        "device": device.type,
        "step": start,
        "training": training,
    }
    with deferring() as deferred, ranks.started(job, settings.devices, settings.num_nodes, run.folder) as mine:
        callbacks = [*_callbacks(run, training, deferred), *further]
        fit(config, model, source, device, start, training, mine, callbacks, loggers, run.folder)


def _evaluate(run: Run, model: SceneModel, source: VideoSource, device: torch.device) -> dict[str, float]:
    """Scores and pictures of the final weights, in the run's folder; the paper's four scores."""
    config = run.job.config
    asked = config.evaluation
    schedule = schedule_at({n: s(config.trainer.max_steps) for n, s in build_schedules(config).items()}, device)
    scored, _ = evaluation.evaluate(
        evaluation.Asked(
            folder=run.folder,
            split=asked.split,
            about={"seed": config.seed, "data_fingerprint": source.fingerprint, "data": source.describe()},
            settings=asked.model_dump(),
            beside={"validation_foreground_share": run.record.get("foreground_share")},
            pictures=asked.pictures,
            view=run.view_folder,
            curves=run.curves_file,
        ),
        Predictor(model, schedule, device, config.trainer.precision, seed=config.seed, chunk=asked.chunk),
        whole_loader(source.sets[asked.split], asked.batch_size, asked.videos),
    )
    return {f"{asked.split}/{key}": scored["total"][key] for key in evaluation.COLUMNS if key in scored["total"]}


def _show(run: Run) -> None:
    """Prints the rows of scores and the paths of drawings."""
    for split, scored in read_json(run.metrics_file)["splits"].items():
        console.say(evaluation.summary(split, scored["total"]))
    pictures = [path for path in run.view_folder.glob("*") if path.is_file()]
    for path in sorted(pictures, key=lambda path: (path.stem != "film_strip", path.name)):
        console.say(str(path))


def _checkpoint(run: Run) -> dict[str, Any] | None:
    """What to resume from; a damaged last checkpoint is reported, and the one before it taken."""
    paths = [path for path in (run.last, checkpoints.previous(run.last)) if path.exists()]
    known = [str(name) for _, name in trust.targets(run.job.raw)]  # the user's own configuration
    for path in paths:
        try:
            return checkpoints.load(path, known=known)
        except UserError as error:
            console.warn(str(error))
    if paths:
        raise UserError(
            f"No whole checkpoint is left in {run.last.parent}: remove {run.folder} to start this run again."
        )
    return None


def _compare_configuration(run: Run, checkpoint: dict[str, Any]) -> None:
    """Refuses to resume from the weights of another configuration, which may have the very same shapes."""
    if fingerprint(checkpoint["config"]) != fingerprint(run.job.raw):
        other = " ".join(f"{key}={word}" for key, word in checkpoint["choices"].items() if key in cli.CHOICES)
        raise UserError(
            f"The checkpoint in {run.folder} was made with another configuration ({other or 'no choices stored'}): "
            "put the run's own checkpoint back, or remove the folder to start again."
        )


def _load_weights(run: Run, model: SceneModel, weights: dict[str, torch.Tensor]) -> None:
    try:
        model.load_state_dict(weights)
    except RuntimeError as error:
        raise UserError(
            f"The checkpoint in {run.folder} was made by other code ({one_line(error)}): "
            "go back to that code, or remove the folder to start again."
        ) from error


def _untrained(run: Run, model: SceneModel) -> dict[str, Any]:
    job = run.job
    inference = checkpoints.inference_part(job.config, model, 0)
    return {"step": 0, "inference": inference, "config": job.raw, "choices": job.choices, "training": None}


def _compare_data(run: Run, found: str, checkpoint: dict[str, Any] | None) -> None:
    """Refuses to resume with other data than the run began with."""
    stored = run.record["data_fingerprint"]
    if checkpoint is not None and stored is not None and stored != found:
        raise UserError(
            f"{run.folder} was started with other data (fingerprint {stored[:8]}, now {found[:8]}): "
            "bring the data back, or remove the run folder to start again."
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
    keep = own_callbacks.Checkpoints(
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
