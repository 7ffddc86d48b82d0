"""Evaluates checkpoint files: where their results go, what has been done before."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, read_json, unwritable
from apex_lab.base.validation import one_line, sentence
from apex_lab.config import components
from apex_lab.config.building import device as device_of
from apex_lab.config.job import Job, check_job
from apex_lab.config.schema import PathsPart
from apex_lab.data import VideoSource, whole_loader
from apex_lab.evaluation.export import export_path
from apex_lab.evaluation.files import here, of_another_version
from apex_lab.evaluation.other_data import OtherData
from apex_lab.evaluation.partial import Parts
from apex_lab.evaluation.results import summary
from apex_lab.evaluation.scoring import ScoringPart
from apex_lab.evaluation.whole import Asked, evaluate
from apex_lab.inference.loading import trained_model
from apex_lab.inference.predictor import Predictor
from apex_lab.metrics.evaluator import versions
from apex_lab.runs import checkpoints, provenance
from apex_lab.runs.state import is_whole
from apex_lab.scene import SceneModel, schedule_at


@dataclass(frozen=True)
class Request:
    """What is asked for, the same for all checkpoints; fields as the keys of conf/evaluate.yaml."""

    split: str
    videos: int | None
    scoring: ScoringPart
    pictures: int
    pictures_by: str
    export: str | None
    save_interval: int
    again: bool
    accelerator: str
    folder: Path | None
    paths: PathsPart
    data: OtherData = field(default_factory=OtherData)
    batch_size: int = 4
    chunk: int | None = None
    trust: bool = False
    model: Mapping[str, Any] = field(default_factory=dict)


def load(
    file: Path, paths: PathsPart, data: OtherData | None = None, trusted: bool = False
) -> tuple[dict[str, Any], Job]:
    """A checkpoint and the checked configuration that made it, with the folders of this machine.

    Args:
        file: the checkpoint.
        paths: folders of this machine.
        data: what stands in place of the data that the model was trained with.
        trusted: build whatever the checkpoint names, not only the project's own components.

    Raises:
        UserError: the file is no usable checkpoint, or the data's settings do not fit.
    """
    content = checkpoints.load(file, trusted)
    stored = here(file, content["config"], paths, trusted)
    try:
        job = check_job(stored, content["choices"], to_train=False)
    except UserError as error:
        raise of_another_version(file, error) from error
    if data:
        node = data.instead_of(stored["data"])
        components.check(node, "data")
        job = dataclasses.replace(job, config=job.config.model_copy(update={"data": node}))
    return content, job


def refuse_without_posterior(model: SceneModel, file: Path) -> None:
    """Looks for a posterior, which `scoring.masks=posterior` asks for.

    Raises:
        UserError: the model has none.
    """
    if not model.has_posterior:
        raise UserError(f"scoring.masks = posterior goes with mixture likelihoods alone: leave out {file}.")


def evaluate_checkpoint(request: Request, file: Path, alone: bool) -> None:
    """Evaluates one checkpoint, or reports that it was done before; prints rows and paths.

    Args:
        request: of the command.
        file: the checkpoint.
        alone: it is the only one, so a folder that was given is its own.

    Raises:
        UserError: the checkpoint does not fit, or another process works on it.
    """
    content, job = load(file, request.paths, request.data, request.trust)
    try:
        model = trained_model(content["inference"], request.model)
    except UserError as error:
        raise UserError(sentence(f"{file}: {one_line(error)}")) from error
    if request.scoring.masks == "posterior":
        refuse_without_posterior(model, file)
    with open(file, "rb") as opened:
        digest = hashlib.file_digest(opened, "sha256").hexdigest()
    folder = make_folder(_folder(request, file, content, job, model, digest, alone))
    lock = FileLock(str(folder / ".lock"))
    try:
        lock.acquire(blocking=False)
    except Timeout as error:
        raise UserError(f"{folder} is being worked on by another process: wait for it or stop it.") from error
    except OSError as error:
        raise unwritable(folder, error) from error
    with lock:
        _evaluate(request, file, content, job, model, digest, folder)


def _evaluate(
    request: Request,
    file: Path,
    content: Mapping[str, Any],
    job: Job,
    model: SceneModel,
    digest: str,
    folder: Path,
) -> None:
    device = device_of(request.accelerator)
    source = components.build(job.config.data, "data")
    if not isinstance(source, VideoSource):
        raise UserError(f"data._target_ = {job.config.data['_target_']!r} is not an apex_lab.data.VideoSource.")
    source.prepare()
    source.open()
    key = _key(request, digest, source.fingerprint, device)
    view = folder / "view" / request.split
    done = None if request.again else _done(folder, request, key)
    if done is not None:
        _parts(request, folder, key).remove()  # a kill may have come between the results and this
        console.say(f"evaluated already (again=true does it once more): {folder / 'metrics.json'}")
        pictures = sorted(view.glob("*"), key=_film_strip_first) if done.get("pictures") else []
        exported = [export_path(folder, request.split, request.export)] if request.export is not None else []
        _show(request.split, done, [folder / "metrics.json", *exported, *pictures])
        return
    parts = _parts(request, folder, key)
    inference = content["inference"]
    schedule = schedule_at(inference["schedule"], device)
    asked = Asked(
        folder=folder,
        split=request.split,
        about={
            **{"seed": job.config.seed, "step": content["step"], "data_fingerprint": source.fingerprint},
            **{"data": source.describe()},
            **{"checkpoint_sha256": digest, "evaluation": key},
        },
        settings={
            **{"checkpoint": str(file), "split": request.split, "videos": request.videos},
            **({"model": dict(request.model)} if request.model else {}),
        },
        scoring=request.scoring,
        pictures=request.pictures,
        pictures_by=request.pictures_by,
        view=view,
        curves=run_folder(file) / "curves.csv",
        export=request.export,
    )
    posterior = request.scoring.masks == "posterior"
    predictor = Predictor(model, schedule, device, inference["precision"], posterior, inference["seed"], request.chunk)
    batches = whole_loader(source.sets[request.split], request.batch_size, request.videos)
    scored, paths = evaluate(asked, predictor, batches, parts)
    _show(request.split, scored, [folder / "metrics.json", *paths])


def _show(split: str, scored: Mapping[str, Any], paths: Sequence[Path]) -> None:
    console.say(summary(split, scored["total"]))
    for path in paths:
        console.say(str(path))


def _film_strip_first(path: Path) -> tuple[bool, str]:
    return path.stem != "film_strip", path.name


def run_folder(file: Path) -> Path:
    """The folder of the run that a checkpoint file would belong to."""
    return Path(os.path.normpath(file.parent / ".."))


def _folder(
    request: Request,
    file: Path,
    content: Mapping[str, Any],
    job: Job,
    model: SceneModel,
    digest: str,
    alone: bool,
) -> Path:
    """Where results go.

    The run's own folder takes what belongs in tables: all videos of a split, scored as by default, at the end of
    training. Everything else has a folder of its own, so it never takes the place of that.
    """
    of_file = f"{file.stem}_{digest[:8]}"
    if request.folder is not None:
        return request.folder if alone else request.folder / of_file
    run = run_folder(file)
    in_run = (run / "run.json").is_file()
    usual = request.scoring == ScoringPart() and not request.model
    early = (content["training"] or {}).get("ended", False)  # a callback may end training
    ended = early or content["step"] >= job.config.trainer.max_steps or not model.needs_training
    if in_run and file.name == "last.ckpt" and ended and usual and request.videos is None and not request.data:
        return run
    words = [file.stem if in_run and ended else of_file, request.split]
    words += [] if request.videos is None else [str(request.videos)]
    words += [f"data_{_digest(job.config.data)}"] if request.data else []
    other = {**request.scoring.model_dump(exclude_defaults=True), **({"model": request.model} if request.model else {})}
    words += [] if usual else [_digest(other)]
    return (run if in_run else Path(request.paths.outputs)) / "evaluate" / "_".join(words)


def _key(request: Request, digest: str, data: str, device: torch.device) -> str:
    """Names an evaluation: equal only if everything is equal that can change its results."""
    own = {name: getattr(request, name) for name in ("split", "videos", "pictures", "pictures_by", "export")}
    own |= {"model": request.model} if request.model else {}
    made_by = {"versions": versions(), "commit": provenance.commit()[0], "device": device.type}
    return _digest({"checkpoint": digest, "data": data, "scoring": request.scoring.model_dump(), **own, **made_by}, 32)


def _digest(content: Mapping[str, Any], digits: int = 8) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:digits]


def _done(folder: Path, request: Request, key: str) -> dict[str, Any] | None:
    """What is stored of this very evaluation, if it came to its end and its export is still there."""
    file = folder / "metrics.json"
    try:
        splits = read_json(file).get("splits") if file.exists() else None
    except UserError:
        return None  # what is made anew takes its place, and says so
    scored = splits.get(request.split) if isinstance(splits, dict) else None
    if not isinstance(scored, dict) or scored.get("evaluation") != key or not is_whole(scored):
        return None
    if request.export is not None and not export_path(folder, request.split, request.export).exists():
        return None
    return scored


def _parts(request: Request, folder: Path, key: str) -> Parts:
    """What was done before of this very evaluation; parts of others of this split are of no use and removed."""
    own = folder / f".{request.split}_{key[:16]}"
    for other in folder.glob(f".{request.split}_*"):
        if request.again or other != own:
            Parts(other, request.save_interval).remove()
    return Parts(own, request.save_interval)
