"""A model's predictions in the formats that other people's tools read."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

from torch.utils.data import Dataset, Subset

from apex_lab.evaluation.parts import Tally
from apex_lab.metrics import ObjectMetadata, p2d_metadata
from apex_lab.predictions import PredictedVideo, open_writer

Export = Literal["npz", "coco", "weis", "davis", "mots", "mot"]
EXPORTS: Sequence[str] = ("npz", "coco", "weis", "davis", "mots", "mot")
_SUFFIXES = {"coco": ".json", "weis": ".json"}


def export_path(folder: Path, split: str, format: str, truth: bool = False) -> Path:
    """The file, or for davis, mots and mot the folder, that an export of a split makes."""
    name = f"{split}.{format}{'.truth' if truth else ''}{_SUFFIXES.get(format, '')}"
    return folder / "predictions" / name


def write(
    folder: Path, split: str, format: str, parts: Iterable[Tally], dataset: Dataset[dict[str, Any]]
) -> list[Path]:
    """Writes predictions and, in formats that keep it apart, the ground truth.

    The npz file has one-hot masks: each pixel belongs to the component that won it, so a score of the file is the
    score of the model.

    Args:
        folder: of the results; files go to its `predictions`.
        split: names them.
        format: one of `EXPORTS`.
        parts: tallies that hold identities, read as often as needed.
        dataset: where the ground truth is.

    Returns:
        The paths, predictions first.
    """
    paths = []
    ignore_label = next((part.evaluator.settings.ignore_label for part in parts), None)
    for truth in (False,) if format == "npz" else (False, True):
        path = export_path(folder, split, format, truth)
        for draft in path.parent.glob(f".{path.name}.*"):
            draft.unlink()  # left by a kill in the middle of writing
        with open_writer(format, path, truth, ignore_label) as writer:
            for part in parts:
                for name, (identities, backgrounds) in part.identities.items():
                    place = part.positions[name]
                    labels = dataset[place]["segmentation"].numpy()
                    writer.add(
                        PredictedVideo(
                            name, identities, labels, background_ids=backgrounds, objects=objects_of(dataset, place)
                        )
                    )
        paths.append(path)
    return paths


def objects_of(dataset: Dataset[dict[str, Any]], place: int) -> ObjectMetadata | None:
    """What a data set knows of a video's objects, if it says anything (`P2D.meta`).

    Args:
        dataset: the split, or a part of it.
        place: of the video in `dataset`.
    """
    while isinstance(dataset, Subset):
        place, dataset = dataset.indices[place], dataset.dataset
    meta = getattr(dataset, "meta", None)
    return None if meta is None else p2d_metadata(meta(place))
