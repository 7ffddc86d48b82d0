"""A model's predictions in the formats that other people's tools read."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

from apex_lab.base.files import drafts, writing
from apex_lab.data.video_set import VideoSet
from apex_lab.evaluation.partial import Predicted
from apex_lab.formats import PredictedVideo, open_writer

Export = Literal["npz", "coco", "weis", "davis", "mots", "mot"]
EXPORTS: Sequence[str] = ("npz", "coco", "weis", "davis", "mots", "mot")
_SUFFIXES = {"coco": ".json", "weis": ".json"}


def export_path(folder: Path, split: str, format: str, truth: bool = False) -> Path:
    """The file, or for davis, mots and mot the folder, that an export of a split makes."""
    name = f"{split}.{format}{'.truth' if truth else ''}{_SUFFIXES.get(format, '')}"
    return folder / "predictions" / name


def write(
    folder: Path,
    split: str,
    format: str,
    predictions: Iterable[Predicted],
    videos: VideoSet,
    ignore_label: int | None = None,
) -> list[Path]:
    """Writes predictions and, in formats that keep it apart, the ground truth.

    The npz file has one-hot masks: each pixel belongs to the component that won it, so a score of the file is the
    score of the model.

    Args:
        folder: of the results; files go to its `predictions`.
        split: names them.
        format: one of `EXPORTS`.
        predictions: of all videos, read as often as needed.
        videos: where the ground truth is; an unlabelled set has none, and only predictions are written.
        ignore_label: label of the ground truth that is left out of every score; marked as each format does.

    Returns:
        The paths, predictions first.

    Raises:
        UserError: the disk is full or the folder cannot be written; nothing new stands under its name then.
    """
    paths = []
    for truth in (False,) if format == "npz" or not videos.labelled else (False, True):
        path = export_path(folder, split, format, truth)
        for draft in (*drafts(path.parent, path.name), *drafts(path), *(d for f in path.glob("*/") for d in drafts(f))):
            draft.unlink()  # left by a kill in the middle of writing
        with writing(path), open_writer(format, path, truth, ignore_label) as writer:
            for each in predictions:
                labels = videos[each.position]["segmentation"].numpy() if videos.labelled else None
                about = videos.metadata(each.position)
                writer.add(
                    PredictedVideo(each.name, each.identities, labels, background_ids=each.backgrounds, objects=about)
                )
        paths.append(path)
    return paths
