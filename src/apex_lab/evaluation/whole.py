"""One whole evaluation: scores, pictures, export, record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from apex_lab.evaluation import export as exports
from apex_lab.evaluation import pictures
from apex_lab.evaluation import results as record
from apex_lab.evaluation.partial import Parts
from apex_lab.evaluation.pictures import PICTURES_BY
from apex_lab.evaluation.score import Batches, score, video_set
from apex_lab.evaluation.scoring import ScoringPart
from apex_lab.inference.predictor import Predictor


@dataclass(frozen=True)
class Asked:
    """The request of an evaluation.

    Attributes:
        folder: where results go.
        split: name of what is scored.
        about: entries to be stored with the split (checkpoint, seed, ...).
        settings: entries to be stored among its settings.
        beside: entries to be stored at the top of metrics.json.
        scoring: how.
        pictures: how many videos are drawn.
        pictures_by: what ranks videos for that.
        view: where pictures go.
        curves: a table of curves to draw too.
        export: format to write predictions in; needs parts.
    """

    folder: Path
    split: str
    about: Mapping[str, Any]
    settings: Mapping[str, Any]
    beside: Mapping[str, Any] = field(default_factory=dict)
    scoring: ScoringPart = field(default_factory=ScoringPart)
    pictures: int = 3
    pictures_by: str = PICTURES_BY
    view: Path | None = None
    curves: Path | None = None
    export: str | None = None


def evaluate(
    asked: Asked, predictor: Predictor, batches: Batches, parts: Parts | None = None
) -> tuple[dict[str, Any], list[Path]]:
    """Scores, draws, exports and stores; metrics.json is written last, so it is there only when all else is.

    Args:
        asked: what to do.
        predictor: the model.
        batches: of the split, in order.
        parts: where predictions are kept until all are made.

    Returns:
        What metrics.json holds of the split, and the paths of exports and pictures, film strip first among those.
    """
    videos = video_set(batches)
    tally = score(predictor, batches, asked.scoring, parts)
    result = tally.evaluator.result() if videos.labelled else record.unlabelled(tally)
    if videos.labelled:
        chosen = pictures.choose(result["per_video"], asked.pictures, asked.pictures_by)
    else:
        chosen = pictures.spread(list(tally.positions), asked.pictures)
    view = asked.view or asked.folder / "view"
    drawn = pictures.draw(view, chosen, asked.pictures_by, tally.positions, predictor, videos, asked.curves)
    written = []
    if asked.export is not None:
        assert parts is not None
        written = exports.write(asked.folder, asked.split, asked.export, parts, videos, asked.scoring.ignore_label)
    about = {**asked.about, "settings": {**asked.settings, "scoring": asked.scoring.stored(predictor.model.tracks)}}
    scored = record.store(asked.folder, asked.split, tally, result, about, chosen, asked.beside)
    if parts is not None:
        parts.remove()
    return scored, [*written, *drawn]
