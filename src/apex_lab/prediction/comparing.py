"""Several trained models on the same clips of a data set or of a person's own videos, as film strips."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import default_collate

from apex_lab.base import console, interrupts
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder
from apex_lab.data import VideoSet
from apex_lab.inference.predictor import Batch, Predictor
from apex_lab.metrics.linking import link_frames
from apex_lab.scene import Scene
from apex_lab.videos import Fit, Source, framing, open_video
from apex_lab.view.colors import rgb8
from apex_lab.view.comparison import Shown, comparison

SIDE = 128
"""Smallest side in pixels of the clips that are cut from own videos."""


@dataclass(frozen=True)
class Model:
    """A loaded model and its caption."""

    name: str
    predictor: Predictor
    input_size: tuple[int, int]


def clips_of_set(videos: VideoSet, clips: int | Sequence[int]) -> Iterator[Batch]:
    """Videos of a data set, one at a time.

    Args:
        videos: the set.
        clips: their indices, or how many, evenly spaced.

    Raises:
        UserError: an index that the set does not have; said before the first video is read.
    """
    count = len(videos)
    if isinstance(clips, int):
        chosen = np.unique(np.linspace(0, count - 1, min(clips, count)).round().astype(int)).tolist()
    else:
        chosen = list(clips)
    for index in chosen:
        if not 0 <= index < count:
            raise UserError(f"clips holds {index}, but there are {count} videos: give 0 to {count - 1}.")
    return (default_collate([videos[index]]) for index in chosen)


@dataclass(frozen=True)
class Cut:
    """Which frames of own videos are shown; fields as the keys of conf/compare.yaml."""

    fit: Fit
    start: int
    every: int
    frames: int


def clips_of_videos(
    sources: Sequence[Source], models: Sequence[Model], cut: Cut, failed: dict[Source, str]
) -> Iterator[Batch]:
    """The first frames of own videos, one video at a time, cropped or letterboxed to a square.

    Args:
        sources: the videos.
        models: whose inputs say how large the square is.
        cut: which frames.
        failed: gets the reason for each video that cannot be read, or is too short.
    """
    side = max(SIDE, *(max(model.input_size) for model in models))
    for source in sources:
        try:
            yield _clip(source, side, cut)
        except UserError as error:
            failed[source] = str(error)


def _clip(source: Source, side: int, cut: Cut) -> Batch:
    video = open_video(source)
    view = framing(video.size, (side, side), cut.fit)
    wanted = islice(islice(video.frames(cut.start), 0, None, cut.every), cut.frames)
    taken = [view.fitted(frame.image) for frame in wanted]
    if not taken:
        raise UserError(f"{source} has no frame {cut.start}: give a smaller start.")
    images = torch.from_numpy(np.stack(taken)).permute(0, 3, 1, 2).contiguous()
    return {"video": images[None], "name": [video.name]}


def compare_clips(models: Sequence[Model], clips: Iterator[Batch], folder: Path, columns: int) -> list[Path]:
    """Draws each clip with all models; the paths.

    Raises:
        UserError: a model that reads the ground truth, and a clip without; a file that cannot be written.
    """
    paths: list[Path] = []
    for batch in clips:
        interrupts.check()
        name = batch["name"][0]
        truth = batch["segmentation"][0].long().numpy() if "segmentation" in batch else None
        shown = [_shown(model, batch) for model in models]
        path = make_folder(folder) / f"{_file_name(name, paths)}.png"
        comparison(path, name, batch["video"][0].permute(0, 2, 3, 1).numpy(), shown, truth, columns)
        console.say(str(path))
        paths.append(path)
    return paths


def _shown(model: Model, batch: Batch) -> Shown:
    needs_labels = model.predictor.model.needs_labels
    if needs_labels and "segmentation" not in batch:
        raise UserError(f"{model.name} reads the ground truth, which {batch['name'][0]} has not: leave the model out.")
    scene = model.predictor(batch)
    labels = scene.segmentation()[0].cpu().numpy().astype(np.int64)
    background = _background(scene, labels)
    kind = "segmentation"
    if not model.predictor.model.tracks:
        labels, kind = link_frames(labels.clip(min=0), background), "segmentation, linked"
    picture: Any = scene.reconstruction[0].float().cpu().permute(0, 2, 3, 1).numpy()
    return Shown(model.name, labels, background, rgb8(picture), kind)


def _background(scene: Scene, labels: np.ndarray) -> np.ndarray:
    """Pixels of background components, whose identities no object of the same frame has."""
    ids = scene.ids[0][:, scene.background].cpu().numpy()
    return np.stack([np.isin(frame, own[own >= 0]) for frame, own in zip(labels, ids, strict=True)])


def _file_name(name: str, before: Sequence[Path]) -> str:
    """The clip's name, as far as a file may have it; with a number, where two have the same."""
    name = re.sub(r"[/\0]", "_", name).lstrip(".") or "video"
    taken = {path.stem for path in before}
    numbered = (name if n == 1 else f"{name}_{n}" for n in range(1, len(before) + 2))
    return next(each for each in numbered if each not in taken)
