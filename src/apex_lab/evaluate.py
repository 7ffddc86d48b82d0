"""Scores a checkpoint on a split and draws what it sees.

python -m apex_lab.evaluate checkpoint=outputs/<run>/seed_0
python -m apex_lab.evaluate checkpoint=weights.ckpt split=val videos=20
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from apex_lab import checkpoints, cli, components, config, console, evaluation
from apex_lab.errors import UserError
from apex_lab.files import read_json
from apex_lab.scene import schedule_at
from apex_lab.validation import one_line, sentence, validate


class EvaluateConfig(BaseModel):
    """The root of conf/evaluate.yaml."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    checkpoint: str = Field(min_length=1)
    split: Literal["train", "val", "test"]
    videos: int | None = Field(ge=1)
    pictures: int = Field(ge=0)
    accelerator: Literal["auto", "cpu", "gpu"]
    folder: str | None = Field(min_length=1)
    paths: config.PathsPart


@dataclass(frozen=True)
class Evaluation:
    """One checked evaluation: what is asked for, the checkpoint file, its content, and the run that made it."""

    asked: EvaluateConfig
    file: Path
    checkpoint: dict[str, Any]
    job: config.Job


def main() -> None:
    """Entry point: `python -m apex_lab.evaluate`."""
    cli.launch("evaluate", check_evaluation, evaluate, lambda job: str(job.file))


def check_evaluation(raw: dict[str, Any], choices: Mapping[str, str], overrides: Sequence[str]) -> Evaluation:
    """Checks what is asked for and reads the checkpoint.

    Raises:
        UserError: unknown key, impossible value, or no usable checkpoint; one sentence.
    """
    raw = {key: value for key, value in raw.items() if key != "hydra"}
    asked = validate(EvaluateConfig, raw, "")
    assert isinstance(asked, EvaluateConfig)
    config.refuse_missing(raw)
    config.device(asked.accelerator)
    file = checkpoint_file(Path(asked.checkpoint))
    checkpoint = checkpoints.load(file)
    stored = _moved(checkpoint["config"], asked)
    try:
        job = config.check_job(stored, checkpoint["choices"])
    except UserError as error:
        raise UserError(sentence(f"{file} was made by another version of apex_lab: {one_line(error)}")) from error
    return Evaluation(asked, file, checkpoint, job)


def checkpoint_file(path: Path) -> Path:
    """The checkpoint that a path means: the file itself, or a run folder's last one.

    Raises:
        UserError: there is none.
    """
    if path.is_dir():
        inside = path / "checkpoints" / "last.ckpt"
        if inside.is_file():
            return inside
        runs = sorted(folder.name for folder in path.glob("seed_*"))
        hint = f"; it holds {', '.join(runs)}: give one of them" if runs else ""
        raise UserError(sentence(f"checkpoint = {path} is a folder without checkpoints/last.ckpt{hint}"))
    if not path.is_file():
        raise UserError(f"checkpoint = {path} does not exist: give a .ckpt file or a run folder.")
    return path


def evaluate(job: Evaluation) -> None:
    """Scores, stores, draws and prints the row and the pictures' paths."""
    asked, settings = job.asked, job.job.config
    device = config.device(asked.accelerator)
    model = config.build_model(settings)
    try:
        model.load_state_dict(job.checkpoint["weights"])
    except RuntimeError as error:
        raise UserError(sentence(f"The weights in {job.file} do not fit its model: {one_line(error)}")) from error
    data = components.build(settings.data, "data")
    data.prepare_data()
    data.setup("test")
    schedule = schedule_at({n: s(job.checkpoint["step"]) for n, s in config.build_schedules(settings).items()}, device)
    batches = data.loader(asked.split, asked.videos)
    evaluator, items = evaluation.evaluate(model, batches, schedule, device, settings.trainer.precision, asked.pictures)
    folder = _folder(job)
    asked_for = {"checkpoint": str(job.file), "split": asked.split, "videos": asked.videos}
    stored = evaluation.store(folder, asked.split, evaluator, asked_for)
    pictures = evaluation.draw(folder / "view", items)
    console.say(evaluation.summary(asked.split, read_json(stored)["splits"][asked.split]))
    for path in (stored, *pictures):
        console.say(str(path))


def _folder(job: Evaluation) -> Path:
    """Where the results go."""
    if job.asked.folder is not None:
        return Path(job.asked.folder)
    words = [job.file.stem, job.asked.split, *([] if job.asked.videos is None else [str(job.asked.videos)])]
    run = job.file.parent.parent
    parent = run if (run / "run.json").is_file() else Path(job.asked.paths.outputs)
    return parent / "evaluate" / "_".join(words)


def _moved(stored: Mapping[str, Any], asked: EvaluateConfig) -> dict[str, Any]:
    """The configuration of the run with the folders of this machine."""
    old, new = stored["paths"]["data"], asked.paths.data
    data = {key: new if value == old else value for key, value in stored["data"].items()}
    return {**stored, "data": data, "paths": asked.paths.model_dump()}


if __name__ == "__main__":
    main()
