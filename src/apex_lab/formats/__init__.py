"""Predictions as files: formats that other people's tools read and write, and their scores.

| format | what | written by | read |
| --- | --- | --- | --- |
| `npz` | soft masks and ids, `V__gt`, `V__masks`, `V__ids` per video V | `NpzWriter` | yes |
| `coco` | JSON that `pycocotools` reads: a result list, ground truth with images | `CocoWriter` | yes |
| `weis` | JSON that the public program of Weis et al. reads | `WeisWriter` | yes |
| `davis` | palette PNGs | `DavisWriter` | yes |
| `mots` | MOTS text, masks | `MotWriter(masks=True)` | yes |
| `mot` | MOTChallenge text, boxes | `MotWriter` | no, boxes hold no masks |

Ground truth can be written in all of them (npz files hold it anyway) and read back from all but `mot`.

`score_predictions` scores what can be read; the result's keys are described in `apex_lab.metrics.KEYS` and in the
result itself: `settings`, `versions`, `total` (the data set), `per_video`, `per_frame`, `per_object`, `hota_alpha`
(HOTA per threshold) and `events` (CLEAR MOT events).
"""

from __future__ import annotations

from pathlib import Path

from apex_lab.base.errors import UserError
from apex_lab.formats.coco import CocoWriter
from apex_lab.formats.davis import DavisWriter
from apex_lab.formats.mot import MotWriter
from apex_lab.formats.npz import NpzWriter
from apex_lab.formats.scored_files import score_predictions, write_result
from apex_lab.formats.truth import open_truth, p2d_video_name
from apex_lab.formats.video import PredictedVideo
from apex_lab.formats.weis import WeisWriter

EXPORTS = ("npz", "coco", "weis", "davis", "mots", "mot")
"""Formats that `open_writer` writes."""


Writer = NpzWriter | CocoWriter | WeisWriter | DavisWriter | MotWriter


def open_writer(format: str, path: str | Path, truth: bool = False, ignore_label: int | None = None) -> Writer:
    """A writer of one format, to be used with `with` and fed with `add(PredictedVideo)`.

    Args:
        format: one of `EXPORTS`.
        path: the file, or for davis, mots and mot the folder.
        truth: write the ground truth in place of the predictions (npz files hold both anyway).
        ignore_label: the true label that is to be ignored, which is marked as the format does it.

    Raises:
        UserError: no such format.
    """
    if format == "npz":
        return NpzWriter(path)
    if format == "coco":
        return CocoWriter(path, truth, ignore_label)
    if format == "weis":
        return WeisWriter(path, truth, ignore_label)
    if format == "davis":
        return DavisWriter(path, truth, ignore_label)
    if format in ("mots", "mot"):
        return MotWriter(path, format == "mots", truth, ignore_label)
    raise UserError(f"there is no export format {format!r}; choose one of {', '.join(EXPORTS)}")


__all__ = [
    "EXPORTS",
    "CocoWriter",
    "DavisWriter",
    "MotWriter",
    "NpzWriter",
    "PredictedVideo",
    "WeisWriter",
    "Writer",
    "open_truth",
    "open_writer",
    "p2d_video_name",
    "score_predictions",
    "write_result",
]
