"""Trains a model on a data set and evaluates it.

python -m apex_lab.train scale=cpu
python -m apex_lab.train +ablation=no_entropy seed=0,1,2,3 scale=cpu -m
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.loggers import Logger

from apex_lab import evaluation
from apex_lab.base import console, interrupts
from apex_lab.base.errors import UserError
from apex_lab.base.files import read_json
from apex_lab.base.interrupts import Interrupted, deferring, interruptible
from apex_lab.base.validation import one_line
from apex_lab.config import command_line as cli
from apex_lab.config import components, initial, trust
from apex_lab.config.building import build_model, build_schedules
from apex_lab.config.building import device as device_of
from apex_lab.config.composition import CHOICES, Composed
from apex_lab.config.consistency import needs_labels
from apex_lab.config.job import Job, check_job, reseeded
from apex_lab.config.schema import InitialPart
from apex_lab.config.upgrades import fingerprint
from apex_lab.data import VideoSource, whole_loader
from apex_lab.inference.predictor import Predictor
from apex_lab.inference.sizes import fitted
from apex_lab.runs import checkpoints
from apex_lab.runs.folder import Outcome, Run, group_name, run_folder
from apex_lab.runs.state import RunState, beating, is_whole, read_state
from apex_lab.scene import SceneModel, Statistics, schedule_at
from apex_lab.training import callbacks as own_callbacks
from apex_lab.training import estimate, longer, ranks, worker
from apex_lab.training.callbacks import Pruned
from apex_lab.training.devices import set_matmul_precision
from apex_lab.training.estimate import try_out
from apex_lab.training.fit import fit
from apex_lab.training.learner import Diverged
from apex_lab.training.loggers import Curves
from apex_lab.training.longer import Shorter
from apex_lab.training.pictures import Pictures
from apex_lab.training.schedules import in_evaluation
from apex_lab.training.showing import Showing, closing


def main() -> None:
    """Entry point: `python -m apex_lab.train`."""
    cli.launch(cli.Command("train", _check, train, title, known=_known, reseeded=_reseeded))


def _check(raw: dict[str, Any], choices: Mapping[str, str], overrides: Sequence[str]) -> Job:
    return _with_data(check_job(raw, choices, overrides))


def _reseeded(job: Job, made: Composed) -> Job:
    return _with_data(reseeded(job, made))


def _with_data(job: Job) -> Job:
    """Refuses a job whose data only the user can bring, before any job of its sweep starts; scores need no data."""
    if _known(job).state != "finished":
        components.build(job.config.data, "data").refuse_missing()
    return job


def _known(job: Job) -> RunState:
    """A run as it stands; finished where `train` would find it so."""
    return read_state(run_folder(job), job.config.evaluation.split)


def title(job: Job) -> str:
    """A run in a few words."""
    return f"{group_name(job)}, seed {job.config.seed}"


def train(job: Job, callbacks: Sequence[L.Callback] = (), command: str | None = None) -> Outcome:
    """Starts a run, resumes it where it stopped, or shows the scores of a finished one.

    Args:
        job: the run.
        callbacks: further ones, on rank 0.
        command: what the run's record names as its command; None: this process's own.

    Returns:
        "finished", or "paused" when `trainer.max_minutes` were over before training was.

    Raises:
        Pruned: a callback ended the run.
        UserError: the run cannot be done as asked; one sentence.
        Interrupted: the process was asked to stop. What is stored stays, and a run that came to its end is recorded as
            finished before that.
    """
    outside = ranks.given()
    ranks.check_given(outside, job.config.trainer.devices, job.config.trainer.num_nodes)
    if outside is not None and outside.rank > 0:
        file = ranks.wait_for(ranks.job_file(run_folder(job)))
        with deferring():
            worker.train_along(file, outside, _named(job))
        return "finished"
    began = time.monotonic()
    with interruptible(), Run(job) as run:
        if run.finished:
            console.say(f"finished already: {run.folder}")
            _show(run)
            return "finished"
        device = device_of(job.config.trainer.accelerator)
        set_matmul_precision(device, job.config.trainer.matmul_precision)
        run.start(command or cli.command_line(), device)
        with beating(run.folder), console.log_to(run.folder / "log.txt"):
            try:
                outcome = _train(run, device, began, callbacks)
            except BaseException as error:
                stop = _stop(error)
                with suppress(UserError, OSError):  # what went wrong is told, though it may not be recorded
                    run.fail(*_reason(stop or error))
                console.note(traceback.format_exc())
                if stop is not None:
                    raise stop from error
                raise
            if outcome == "paused":
                run.pause(f"stopped after {job.config.trainer.max_minutes:g} minutes (trainer.max_minutes)")
                console.say(f"paused at step {run.record['steps']}: {run.record['reason']}; the same command resumes.")
                return "paused"
            run.finish()
            _show(run)
    return "finished"


def _stop(error: BaseException) -> Interrupted | None:
    """A request to stop that ended in another error: the signal has reached processes that this one needs too."""
    signum = interrupts.asked()
    if signum is None or isinstance(error, Interrupted | UserError):
        return None
    return Interrupted(signum)


def _named(job: Job) -> list[str]:
    """The classes that the user's own command names; files in the run folder may name them too."""
    return [str(name) for _, name in trust.targets(job.raw)]


def _reason(error: BaseException) -> tuple[str, Outcome]:
    if isinstance(error, Interrupted):
        return f"stopped by {error}", "interrupted"
    if isinstance(error, Pruned):
        return str(error), "pruned"
    if isinstance(error, UserError):
        return str(error), "diverged" if isinstance(error, Diverged) else "failed"
    return f"{type(error).__name__}: {one_line(error)}", "failed"


def _train(run: Run, device: torch.device, began: float, further: Sequence[L.Callback]) -> Outcome:
    config = run.job.config
    checkpoint = _checkpoint(run)
    if checkpoint is not None:
        _compare_configuration(run, checkpoint)
        run.restore(checkpoint["step"], checkpoint["training"])
    console.say(f"{title(run.job)} on {device.type}: {run.folder}")
    model = build_model(config)
    shorter = _look_ahead(run, model, device, further) if model.needs_training and checkpoint is None else []
    source: VideoSource = components.build(config.data, "data")
    source.prepare()
    source.open()
    interrupts.check()
    _compare_data(run, source.fingerprint, checkpoint)
    if shorter:
        checkpoint = longer.take_over(run, shorter, model)
        if checkpoint is not None:
            run.restore(checkpoint["step"], checkpoint["training"])
    if checkpoint is None and config.init_from is None:
        model.initialise(Statistics(lambda: _median(source, model)))
    elif checkpoint is not None:
        _load_weights(run, model, checkpoint["inference"]["weights"])
        console.say(f"resuming from step {checkpoint['step']}")
    start = checkpoint["step"] if checkpoint else 0
    with closing(_loggers(run, model, start)) as loggers:
        _go_on(loggers, start)
        if not model.needs_training:
            checkpoints.save(run.last, _untrained(run, model))
        elif not _fit(run, model, source, checkpoint, loggers, device, began, further):
            return "paused"
        scored, pictures = _evaluate(run, model, source, device)
        for logger in loggers:
            if isinstance(logger, Showing):
                logger.results(config.evaluation.split, scored, pictures, run.record["steps"])
    return "finished"


def _look_ahead(run: Run, model: SceneModel, device: torch.device, further: Sequence[L.Callback]) -> list[Shorter]:
    """What precedes the data of a run that begins: its weights, a try, and shorter runs that it can go on with."""
    config = run.job.config
    if config.init_from is not None:
        _take_initial(config.init_from, model)
    try_out(config, model)
    # further callbacks would miss what the shorter run did
    shorter = [] if further else longer.find(run.job, _named(run.job))
    if not shorter and device.type == "cpu":
        warning = estimate.warning(config, model)
        if warning is not None:
            console.warn(warning)
    return shorter


def _take_initial(about: InitialPart, model: SceneModel) -> None:
    """Gives a model the weights that its training starts from.

    Raises:
        UserError: their file is gone, damaged, or not what it was when the command was read.
    """
    file = initial.file_of(about.checkpoint)
    weights = checkpoints.weights(file)
    if initial.stored(file).digest != about.weights:
        raise UserError(f"{initial.KEY} = {about.checkpoint} has changed: start the command again with what it is now.")
    initial.refuse_misfit(about, {name: tuple(value.shape) for name, value in model.state_dict().items()})
    model.load_state_dict(weights)
    console.say(f"starting from the weights of {about.checkpoint} ({about.weights[:8]})")


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
    began: float,
    further: Sequence[L.Callback],
) -> bool:
    """The weight updates that are left, or those that `trainer.max_minutes` allow; whether training came to its end."""
    config, settings = run.job.config, run.job.config.trainer
    start = checkpoint["step"] if checkpoint else 0
    training = checkpoint["training"] if checkpoint else None
    if start >= settings.max_steps or (training is not None and training.get("ended")):
        return True
    deadline = None if settings.max_minutes is None else began + 60 * settings.max_minutes
    job = {
        "config": config.model_dump(),
        "weights": model.state_dict(),
        "device": device.type,
        "step": start,
        "training": training,
    }
    with deferring(), ranks.started(job, settings.devices, settings.num_nodes, run.folder) as mine:
        callbacks = [*_callbacks(run), *further, *_pictures(run, loggers)]
        keep = _checkpoints(run, training, source.labelled)
        return fit(config, model, source, device, start, training, mine, callbacks, keep, loggers, run.folder, deadline)


def _evaluate(
    run: Run, model: SceneModel, source: VideoSource, device: torch.device
) -> tuple[dict[str, Any], list[Path]]:
    """Scores and pictures of the final weights, in the run's folder: what metrics.json holds, and the pictures."""
    config = run.job.config
    asked = config.evaluation
    # a callback may have ended training before the last step
    step = run.record["steps"] if model.needs_training else config.trainer.max_steps
    schedule = schedule_at(in_evaluation(build_schedules(config), model, step), device)
    return evaluation.evaluate(
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


def _show(run: Run) -> None:
    """Prints the rows of scores and the paths of drawings."""
    for split, scored in read_json(run.metrics_file)["splits"].items():
        if is_whole(scored):
            console.say(evaluation.summary(split, scored["total"]))
    pictures = [path for path in run.view_folder.glob("*") if path.is_file()]
    for path in sorted(pictures, key=lambda path: (path.stem != "film_strip", path.name)):
        console.say(str(path))


def _checkpoint(run: Run) -> dict[str, Any] | None:
    """What to resume from; a damaged last checkpoint is reported, and the one before it taken."""
    paths = [path for path in (run.last, checkpoints.previous(run.last)) if path.exists()]
    known = _named(run.job)
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
        other = " ".join(f"{key}={word}" for key, word in checkpoint["choices"].items() if key in CHOICES)
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


def _loggers(run: Run, model: SceneModel, step: int) -> list[Logger]:
    """Where values go; a model that does not train has no curves."""
    config = run.job.config
    built = [
        components.build(
            node, f"logger.{name}", **({"run": run} if components.takes(node, f"logger.{name}", "run") else {})
        )
        for name, node in config.logger.items()
    ]
    return [Curves(run.curves_file, step), *built] if model.needs_training else built


def _go_on(loggers: Sequence[Logger], step: int) -> None:
    """Brings what shows the run to where it goes on."""
    curves = next((logger for logger in loggers if isinstance(logger, Curves)), None)
    for logger in loggers:
        if isinstance(logger, Showing):
            logger.go_on(step, curves)


def _callbacks(run: Run) -> list[L.Callback]:
    """Those of the configuration."""
    return [components.build(node, f"callbacks.{name}") for name, node in run.job.config.callbacks.items()]


def _pictures(run: Run, loggers: list[Logger]) -> list[L.Callback]:
    """What draws for loggers that show pictures."""
    interval, last = run.job.config.trainer.validation_interval, run.job.config.trainer.max_steps
    showing = [logger for logger in loggers if isinstance(logger, Showing) and logger.pictures > 0]
    return [Pictures(logger, interval, last) for logger in showing] if interval is not None else []


def _checkpoints(run: Run, training: dict[str, Any] | None, labelled: bool) -> own_callbacks.Checkpoints:
    settings = run.job.config.trainer
    monitor, mode = settings.monitor, settings.monitor_mode
    if not labelled:
        console.say("the videos have no labels, so there are no scores: look at loss, pictures and objects_present")
        if needs_labels(monitor):
            console.say(f"best.ckpt has the lowest val/loss, since {monitor} needs labels (trainer.monitor)")
            monitor, mode = "val/loss", "min"
    return own_callbacks.Checkpoints(
        run,
        settings.checkpoint_interval,
        settings.validation_interval,
        settings.max_steps,
        monitor,
        mode,
        training,
    )


if __name__ == "__main__":
    main()
