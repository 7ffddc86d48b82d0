"""Scores models of this repository, and predictions that other programs made.

python -m apex_lab.evaluate checkpoint=outputs/<run>/seed_0
python -m apex_lab.evaluate 'checkpoint=[weights.ckpt, outputs/<run>]' split=val
python -m apex_lab.evaluate predictions=other.npz
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from apex_lab.base import console, faults
from apex_lab.base.errors import UserError
from apex_lab.base.validation import PathText, did_you_mean, sentence, shown, validate
from apex_lab.config import command_line as cli
from apex_lab.config.building import build_model
from apex_lab.config.building import device as device_of
from apex_lab.config.job import refuse_missing
from apex_lab.config.schema import PathsPart
from apex_lab.evaluation import OF_SCENES, Export, ScoringPart
from apex_lab.evaluation.checkpoint import Request, evaluate_checkpoint, load, refuse_without_posterior
from apex_lab.evaluation.files import Bad, find, listed, look
from apex_lab.evaluation.other_data import OtherData
from apex_lab.evaluation.others import Predictions, check_output, output_of, score_others
from apex_lab.formats.bounds import GIGABYTES
from apex_lab.metrics import KEYS


class EvaluateConfig(BaseModel):
    """The root of conf/evaluate.yaml."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    split: Literal["train", "val", "test"]
    checkpoint: PathText | list[PathText] | None
    videos: int | None = Field(ge=1)
    pictures: int = Field(ge=0)
    pictures_by: str
    export: Export | None
    accelerator: Literal["auto", "cpu", "gpu"]
    folder: PathText | None
    save_interval: int = Field(ge=1)
    again: bool
    predictions: PathText | None
    format: Literal["npz", "coco", "weis", "davis", "mots"] | None
    truth: PathText | None
    partial: bool
    resize: Literal["masks", "truth"] | None
    output: PathText | None
    max_gigabytes: float = Field(default=GIGABYTES, gt=0)
    batch_size: int = Field(default=4, ge=1)
    chunk: int | None = Field(default=None, ge=1)
    data: dict[str, Any] = Field(default_factory=dict)
    model: dict[str, Any] = Field(default_factory=dict)
    seed: int = Field(default=0, ge=0)
    trust: bool = False
    scoring: ScoringPart
    paths: PathsPart


OF_CHECKPOINTS: dict[str, Any] = {
    **{"videos": None, "export": None, "folder": None, "again": False},
    **{"data": {}, "model": {}, "chunk": None, "trust": False},
}
OF_PREDICTIONS: dict[str, Any] = {
    **{"format": None, "truth": None, "partial": False, "resize": None, "output": None},
    **{"max_gigabytes": GIGABYTES},
}
"""Keys of one kind of evaluation alone, with their defaults."""


@dataclass(frozen=True)
class Evaluation:
    """One checked command: predictions of another program, or checkpoint files; `bad` ones cannot be read."""

    asked: EvaluateConfig
    files: tuple[Path, ...] = ()
    bad: Bad = field(default_factory=dict)
    data: OtherData = field(default_factory=OtherData)
    predictions: Predictions | None = None


def main() -> None:
    """Entry point: `python -m apex_lab.evaluate`."""
    cli.launch(
        cli.Command(
            "evaluate",
            check_evaluation,
            evaluate,
            title,
            of_checkpoint=("data.", "model."),
            resumes=lambda job: job.predictions is None and not job.asked.again,
        )
    )


def title(job: Evaluation) -> str:
    """An evaluation in a few words."""
    return str(job.predictions.path) if job.predictions is not None else ", ".join(str(file) for file in job.files)


def check_evaluation(raw: dict[str, Any], choices: Mapping[str, str], overrides: Sequence[str]) -> Evaluation:
    """Checks the command, and looks into every checkpoint; one among several that cannot be read stops nothing.

    Raises:
        UserError: unknown key, impossible value, or something that cannot be evaluated; one sentence.
    """
    raw = {key: value for key, value in raw.items() if key != "hydra"}
    if isinstance(raw.get("evaluation"), Mapping):
        words = " ".join(f"{key}={value}" for key, value in raw["evaluation"].items())
        raise UserError(f"evaluation.* are keys of training: here write {words}.")
    asked = validate(EvaluateConfig, raw, "")
    assert isinstance(asked, EvaluateConfig)
    refuse_missing(raw)
    if asked.checkpoint is None and asked.predictions is None:
        raise UserError("checkpoint is missing: write checkpoint=... or, for another program's, predictions=...")
    if asked.checkpoint is not None and asked.predictions is not None:
        raise UserError("checkpoint and predictions are both given: evaluate one after the other.")
    if asked.predictions is not None:
        _refuse(asked, OF_CHECKPOINTS, "checkpoint")
        return Evaluation(asked, predictions=_predictions(asked))
    _refuse(asked, OF_PREDICTIONS, "predictions")
    ranks = [name for name, key in KEYS.items() if key.better is not None and "video" in key.levels]
    if asked.pictures_by not in ranks:
        hint = did_you_mean(asked.pictures_by, ranks) or f": choose one of {', '.join(ranks)}"
        raise UserError(sentence(f"pictures_by = {shown(asked.pictures_by)} ranks no videos{hint}"))
    if asked.export is not None and asked.scoring.resize == "truth":
        raise UserError(
            "scoring.resize = truth scores masks of the model's size, export writes the video's: leave one out."
        )
    device_of(asked.accelerator)
    files, bad = find([asked.checkpoint] if isinstance(asked.checkpoint, str) else asked.checkpoint or [])
    if not files:
        raise UserError("checkpoint = [] names no file: give a .ckpt file or a run folder.")
    given = [word.lstrip("+").partition("=")[0] for word in overrides if word.lstrip("+").startswith("data.")]
    data = OtherData(asked.data, tuple(key.removeprefix("data.") for key in given))
    good, unread = look(files, asked.paths, data, asked.trust, asked.batch_size, asked.chunk, asked.model)
    if len(files) + len(bad) == 1 and good:
        _, stored = load(files[0], asked.paths, data, asked.trust)
        if asked.scoring.masks == "posterior":
            refuse_without_posterior(build_model(stored.config), files[0])
    bad |= unread
    if not good:
        raise UserError(next(iter(bad.values())) if len(bad) == 1 else listed(bad, len(bad)))
    return Evaluation(asked, files=tuple(good), bad=bad, data=data)


def evaluate(job: Evaluation) -> None:
    """Scores, stores, draws; a checkpoint that fails does not stop the others.

    Raises:
        UserError: some could not be evaluated.
    """
    if job.predictions is not None:
        score_others(job.predictions)
        return
    request = _request(job.asked, job.data)
    count, failed = len(job.files) + len(job.bad), dict(job.bad)
    if count == 1:
        evaluate_checkpoint(request, job.files[0], alone=True)
        return
    for number, file in enumerate(job.files):
        console.say(f"checkpoint {number + 1} of {len(job.files)}: {file}")
        try:
            evaluate_checkpoint(request, file, alone=False)
        except UserError as error:
            console.error(str(error))
            failed[file] = str(error)
        except Exception as error:  # noqa: BLE001 - reported here and below; the others must still be evaluated
            failed[file] = faults.told(error)
            console.error(failed[file])
    if failed:
        raise UserError(listed(failed, count))


def _refuse(asked: EvaluateConfig, others: Mapping[str, Any], kind: str) -> None:
    """Refuses keys of the other kind of evaluation, which would have no effect."""
    for key, unset in others.items():
        value = getattr(asked, key)
        if value != unset:
            raise UserError(f"{key} = {shown(value)} goes with {kind}=... alone: leave it out.")


def _request(asked: EvaluateConfig, data: OtherData) -> Request:
    return Request(
        split=asked.split,
        videos=asked.videos,
        scoring=asked.scoring,
        pictures=asked.pictures,
        pictures_by=asked.pictures_by,
        export=asked.export,
        save_interval=asked.save_interval,
        again=asked.again,
        accelerator=asked.accelerator,
        folder=None if asked.folder is None else Path(asked.folder),
        paths=asked.paths,
        data=data,
        batch_size=asked.batch_size,
        chunk=asked.chunk,
        trust=asked.trust,
        model=asked.model,
    )


def _predictions(asked: EvaluateConfig) -> Predictions:
    assert asked.predictions is not None
    path, scoring, usual = Path(asked.predictions), asked.scoring, ScoringPart()
    if not path.exists():
        raise UserError(f"predictions = {path} does not exist: give an .npz or .json file, or a folder.")
    for key in OF_SCENES:
        if getattr(scoring, key) != getattr(usual, key):
            raise UserError(f"scoring.{key} has no effect on predictions, which hold identities alone: leave it out.")
    if scoring.tracking.drop_background_slot:
        raise UserError(
            "scoring.tracking.drop_background_slot has no effect on predictions, which do not say what is background: "
            "leave it out."
        )
    output = Path(asked.output) if asked.output is not None else output_of(path)
    truth = None if asked.truth is None else Path(asked.truth)
    check_output(output, (path, truth))
    return Predictions(
        path=path,
        format=asked.format,
        truth=truth,
        split=asked.split,
        partial=asked.partial,
        resize=asked.resize,
        output=output,
        scoring=scoring,
        max_gigabytes=asked.max_gigabytes,
    )


if __name__ == "__main__":
    main()
