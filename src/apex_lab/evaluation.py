"""Scores and pictures of a model on a split: the same code at the end of training and in `apex_lab.evaluate`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import DataLoader

from apex_lab.files import make_folder, write_json, write_text
from apex_lab.learner import Batch, as_float
from apex_lab.metrics import scene_identities
from apex_lab.metrics.evaluator import Evaluator
from apex_lab.metrics.scenes import background_identities
from apex_lab.progress import Meter
from apex_lab.scene import Scene, SceneModel, Schedule
from apex_lab.view import Item, render_all
from apex_lab.view.item import one_video

COLUMNS = {"ari_fg": "ARI-FG", "msc_fg": "MSC-FG", "ari": "ARI", "msc": "MSC"}
"""The paper's segmentation scores: key -> heading."""


def predict(model: SceneModel, batch: Batch, schedule: Schedule, precision: int | str = 32) -> Scene:
    """The scene of a batch that lies on the model's device; a model that reads the ground truth is given it."""
    video = as_float(batch["video"])
    if model.needs_labels:
        return model.from_labels(video, batch["segmentation"].long())
    with torch.autocast(video.device.type, dtype=torch.bfloat16, enabled=precision == "bf16-mixed"):
        return model(video, schedule)


@torch.no_grad()
def evaluate(
    model: SceneModel,
    batches: DataLoader[dict[str, Any]],
    schedule: Schedule,
    device: torch.device,
    precision: int | str = 32,
    pictures: int = 0,
) -> tuple[Evaluator, list[Item]]:
    """Scores a model on batches and keeps the first videos for drawing.

    Args:
        model: left in evaluation mode on `device`.
        batches: as the learner's; memory does not grow with their number.
        schedule: values the model is called with, on `device`.
        device: where the model runs.
        precision: 32 or "bf16-mixed".
        pictures: how many of the first videos are kept.
    """
    model.to(device).eval()
    evaluator = Evaluator()
    items: list[Item] = []
    with Meter("video", len(batches.dataset)) as meter:  # type: ignore[arg-type]
        for batch in batches:
            batch = {name: value.to(device) for name, value in batch.items()}
            scene = predict(model, batch, schedule, precision)
            truth = batch["segmentation"].cpu()
            identities = scene_identities(scene, truth.shape[-2:]).cpu()
            backgrounds = background_identities(scene)
            for b, index in enumerate(batch["index"].tolist()):
                evaluator.add(f"{index:05d}", identities[b].numpy(), truth[b].numpy(), background_ids=backgrounds[b])
                if len(items) < pictures:
                    video = batch["video"][b : b + 1].cpu()
                    items.append(Item(f"video {index}", video, one_video(scene, b), 0, truth[b : b + 1]))
            meter.show(len(evaluator.records))
    return evaluator, items


def store(folder: Path, split: str, evaluator: Evaluator, asked: Mapping[str, Any]) -> Path:
    """Writes metrics.json and objects.csv.

    metrics.json holds `settings` (what was asked for, and how it was scored), `versions`, and under `splits` and the
    split's name the numbers of videos and frames and the scores in total and per video; an undefined score is null.
    objects.csv holds a row per true object.
    """
    result = evaluator.result()
    objects = result.pop("per_object")
    scoring, made_by = result.pop("settings"), result.pop("versions")
    sizes = {key: result["total"][key] for key in ("videos", "frames")}
    path = make_folder(folder) / "metrics.json"
    write_text(folder / "objects.csv", objects.to_csv(index=False))
    write_json(
        path,
        {"settings": {**asked, "scoring": scoring}, "versions": made_by, "splits": {split: {**sizes, **result}}},
    )
    return path


def summary(split: str, scored: Mapping[str, Any]) -> str:
    """What was scored, and the paper's four numbers under their headings; `scored` as stored for a split."""
    values = [scored["total"][key] for key in COLUMNS]
    numbers = "".join(f"{math.nan if value is None else value:9.3f}" for value in values)
    head = "".join(f"{heading:>9}" for heading in COLUMNS.values())
    return f"{split}: {scored['videos']} videos, {scored['frames']} frames\n{head}\n{numbers}"


def draw(folder: Path, items: list[Item], curves: Path | None = None) -> list[Path]:
    """Makes the pictures of kept videos; their paths, the film strip first."""
    if not items:
        return []
    return render_all(make_folder(folder), items, curves if curves is not None and curves.is_file() else None)
