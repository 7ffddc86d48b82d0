"""Scores and pictures of a model on a split: the same code at the end of training and in `apex_lab.evaluate`."""

from __future__ import annotations

from apex_lab.evaluation.export import EXPORTS, Export, export_path
from apex_lab.evaluation.partial import Parts, Predicted
from apex_lab.evaluation.pictures import PICTURES_BY
from apex_lab.evaluation.results import COLUMNS, TRACKING_COLUMNS, summary
from apex_lab.evaluation.score import Tally, score
from apex_lab.evaluation.scoring import OF_SCENES, ScoringPart
from apex_lab.evaluation.whole import Asked, evaluate

__all__ = [
    "COLUMNS",
    "EXPORTS",
    "OF_SCENES",
    "PICTURES_BY",
    "TRACKING_COLUMNS",
    "Asked",
    "Export",
    "Parts",
    "Predicted",
    "ScoringPart",
    "Tally",
    "evaluate",
    "export_path",
    "score",
    "summary",
]
