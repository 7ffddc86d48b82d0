"""Evaluates files of predictions that other programs made."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import unwritable
from apex_lab.base.progress import Meter
from apex_lab.evaluation.results import summary
from apex_lab.evaluation.scoring import ScoringPart
from apex_lab.formats import score_predictions, write_result
from apex_lab.formats.bounds import GIGABYTES
from apex_lab.formats.scored_files import plain
from apex_lab.metrics import by_property


@dataclass(frozen=True)
class Predictions:
    """What is to be scored; fields as the keys of conf/evaluate.yaml."""

    path: Path
    format: str | None
    truth: Path | None
    split: str
    partial: bool
    resize: str | None
    output: Path
    scoring: ScoringPart
    max_gigabytes: float = GIGABYTES


def output_of(path: Path) -> Path:
    """Where scores go by default: <name>.metrics.json beside the predictions."""
    path = Path(os.path.abspath(path)) if path.name in ("", "..") else path
    return path.with_name(f"{path.name if path.is_dir() else path.stem}.metrics.json")


def check_output(path: Path, read: Sequence[Path | None] = ()) -> None:
    """Refuses, before any work, a place where the scores cannot be written.

    Args:
        path: the file to be written.
        read: files that the scores are made from, which must outlive them.

    Raises:
        UserError: it is a folder or one of `read`, or lies in a folder that cannot be written.
    """
    if any(given is not None and given.resolve() == path.resolve() for given in read):
        raise UserError(f"output = {path} would overwrite its own input: give the name of another file.")
    if path.is_dir():
        raise UserError(f"output = {path} is a folder: give the name of a file.")
    parent = path.absolute().parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise UserError(f"The scores cannot be written to {path}: choose another file with output=FILE.json.")


def score_others(predictions: Predictions) -> None:
    """Scores a file, writes every number as JSON, prints the rows and the path.

    The JSON holds `source` (what was read), `keys` (meaning, range and direction of every number), `settings`,
    `versions`, `total`, `per_video`, `per_frame`, `per_object`, `by_property`, `hota_alpha` and `events`; undefined
    values are null.

    Raises:
        UserError: the file is missing or malformed; names video, frame and value.
    """
    result = score_predictions(
        predictions.path,
        format=predictions.format,
        truth=predictions.truth,
        split=predictions.split,
        partial=predictions.partial,
        resize=predictions.resize,
        settings=predictions.scoring.settings(tracks=True, details=True),
        max_gigabytes=predictions.max_gigabytes,
        track=_metered,
    )
    result["by_property"] = by_property(result["per_object"])
    try:
        write_result(result, predictions.output)
    except OSError as error:
        raise unwritable(predictions.output, error) from error
    console.say(summary(str(predictions.path), plain(result["total"])))
    console.say(str(predictions.output))


def _metered(names: list[str]) -> Iterator[str]:
    with Meter("video", len(names)) as meter:
        for done, name in enumerate(names):
            yield name
            meter.show(done + 1)
