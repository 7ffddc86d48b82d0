"""Scores and pictures of a model on a split: the same code at the end of training and in `apex_lab.evaluate`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from apex_lab import provenance
from apex_lab.files import make_folder, write_json
from apex_lab.learner import Batch, as_float
from apex_lab.metrics import SceneMetrics, scene_identities
from apex_lab.scene import Scene, SceneModel, Schedule
from apex_lab.view import Item, render_all

COLUMNS = {"ari_fg": "ARI-FG", "msc_fg": "MSC-FG", "ari": "ARI", "msc": "MSC"}
"""The paper's segmentation scores: key -> heading."""


@dataclass(frozen=True)
class Scores:
    """What a model scored on some videos.

    Attributes:
        total: mean over all frames of all videos, per metric key; NaN where no frame counted.
        per_video: one row per video.
        size: how much was scored: `videos`, `frames`, `empty_frames`.
    """

    total: dict[str, float]
    per_video: list[dict[str, int | float]]
    size: dict[str, int]

    def row(self) -> str:
        """The paper's four numbers under their headings."""
        head = "".join(f"{heading:>9}" for heading in COLUMNS.values())
        return head + "\n" + "".join(f"{self.total[key]:9.3f}" for key in COLUMNS)


@torch.no_grad()
def predict(model: SceneModel, batch: Batch, schedule: Schedule, precision: int | str = 32) -> Scene:
    """The scene of a batch that lies on the model's device; a model that reads the ground truth is given it."""
    video = as_float(batch["video"])
    if model.needs_labels:
        return model.from_labels(video, batch["segmentation"].long())
    with torch.autocast(video.device.type, dtype=torch.bfloat16, enabled=precision == "bf16-mixed"):
        return model(video, schedule)


def evaluate(
    model: SceneModel,
    batches: Iterable[Batch],
    schedule: Schedule,
    device: torch.device,
    precision: int | str = 32,
    videos: int | None = None,
    pictures: int = 0,
) -> tuple[Scores, list[Item]]:
    """Scores a model on batches and keeps the first videos for drawing.

    Args:
        model: left in evaluation mode, on `device`.
        batches: as the learner's; memory does not grow with their number.
        schedule: values the model is called with, on `device`.
        device: where the model runs.
        precision: 32 or "bf16-mixed".
        videos: how many; None for all.
        pictures: how many of the first videos are kept.
    """
    model.to(device).eval()
    metrics = SceneMetrics().to(device)
    items: list[Item] = []
    seen = 0
    for batch in batches:
        if videos is not None and seen >= videos:
            break
        batch = _first(batch, None if videos is None else videos - seen, device)
        scene = predict(model, batch, schedule, precision)
        truth = batch["segmentation"].long()
        metrics.update(scene_identities(scene, truth.shape[-2:]), truth, batch["index"])
        for b in range(min(len(truth), pictures - len(items))):
            items.append(_item(batch, scene, b))
        seen += len(truth)
    return Scores(metrics.compute(), metrics.per_video(), metrics.size()), items


def store(folder: Path, split: str, scores: Scores, settings: dict[str, Any]) -> Path:
    """Writes metrics.json: settings, versions, and per split the scores in total and per video."""
    path = make_folder(folder) / "metrics.json"
    part = {**scores.size, "total": scores.total, "per_video": scores.per_video}
    write_json(path, {"settings": settings, "versions": provenance.versions(), "splits": {split: part}})
    return path


def draw(folder: Path, items: list[Item], curves: Path | None = None) -> list[Path]:
    """Makes the pictures of kept videos; their paths, the film strip first."""
    if not items:
        return []
    return render_all(make_folder(folder), items, curves if curves is not None and curves.is_file() else None)


def _first(batch: Batch, count: int | None, device: torch.device) -> dict[str, Any]:
    """The first videos of a batch on a device."""
    return {name: value[:count].to(device) for name, value in batch.items() if isinstance(value, torch.Tensor)}


def _item(batch: Batch, scene: Scene, b: int) -> Item:
    return Item(f"video {int(batch['index'][b])}", batch["video"], scene, b, batch["segmentation"])
