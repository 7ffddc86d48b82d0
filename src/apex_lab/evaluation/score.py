"""From a model and batches to a tally, one batch in memory at a time."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import torch
from torch.utils.data import DataLoader, Dataset, Subset

from apex_lab.base.errors import UserError
from apex_lab.base.progress import Meter
from apex_lab.base.validation import one_line
from apex_lab.evaluation.partial import Parts, Tally
from apex_lab.evaluation.scoring import ScoringPart
from apex_lab.formats import p2d_video_name
from apex_lab.metrics import ObjectMetadata, background_identities, p2d_metadata, scene_identities
from apex_lab.scene import Scene, SceneModel, Schedule
from apex_lab.training.learner import Batch, as_float, foreground_share

Batches = DataLoader[dict[str, Any]]


class Predictor:
    """A model ready to be asked, in evaluation mode.

    Args:
        model: moved to `device`.
        schedule: values the model is called with, on `device`.
        device: where the model runs.
        precision: 32 or "bf16-mixed".
        posterior: scenes come with `SceneModel.posterior` as their masks.
    """

    def __init__(
        self,
        model: SceneModel,
        schedule: Schedule,
        device: torch.device,
        precision: int | str = 32,
        posterior: bool = False,
    ) -> None:
        self.model, self.posterior = model.to(device).eval(), posterior
        self.schedule, self.device, self.precision = schedule, device, precision

    @torch.no_grad()
    def __call__(self, batch: Batch) -> Scene:
        """The scene of a batch; a model that reads the ground truth is given it."""
        video = as_float(batch["video"].to(self.device))
        if self.model.needs_labels:
            return self.model.from_labels(video, batch["segmentation"].to(self.device).long())
        with torch.autocast(video.device.type, dtype=torch.bfloat16, enabled=self.precision == "bf16-mixed"):
            scene = self.model(video, self.schedule)
        if not self.posterior:
            return scene
        return dataclasses.replace(scene, masks=self.model.posterior(scene, video, self.schedule))


def score(
    predictor: Predictor, batches: Batches, split: str, scoring: ScoringPart, parts: Parts | None = None
) -> Tally:
    """Scores every video; what stands in `parts` is not done again.

    Args:
        predictor: the model.
        batches: in order, as the data module gives them.
        split: gives the videos their names.
        scoring: how.
        parts: where what is done is kept; None keeps it in memory alone.

    Raises:
        UserError: the model's output cannot be scored; names the video.
    """
    settings = scoring.settings(predictor.model.tracks)
    done, fresh = Tally.empty(settings), Tally.empty(settings)
    for part in parts or ():
        done.merge(part)
    with Meter("video", length(batches), len(done)) as meter:
        for batch in _rest(batches, len(done)):
            _add(fresh, predictor, batch, split, scoring, batches, len(done), parts is not None and parts.identities)
            meter.show(len(done) + len(fresh))
            if parts is not None and len(fresh) >= parts.interval:
                parts.save(fresh)
                done.merge(fresh)
                fresh = Tally.empty(settings)
    if parts is not None and len(fresh):
        parts.save(fresh)
    done.merge(fresh)
    return done


def length(batches: Batches) -> int:
    """How many videos there are."""
    return len(batches.dataset)  # type: ignore[arg-type]


def _rest(batches: Batches, done: int) -> Batches:
    """The batches after the first `done` videos, composed as they would have been without a break."""
    if done == 0:
        return batches
    return DataLoader(
        Subset(batches.dataset, range(done, length(batches))),
        batch_size=batches.batch_size,
        num_workers=batches.num_workers,
        pin_memory=batches.pin_memory,
        collate_fn=batches.collate_fn,
    )


def _add(
    tally: Tally,
    predictor: Predictor,
    batch: Batch,
    split: str,
    scoring: ScoringPart,
    batches: Batches,
    done: int,
    keep: bool,
) -> None:
    """Scores one batch."""
    scene = predictor(batch)
    truth = batch["segmentation"].numpy()
    names = [p2d_video_name(split, index) for index in batch["index"].tolist()]
    try:
        identities = scene_identities(scene, truth.shape[-2:], scoring.min_presence, scoring.presence_after)
    except ValueError as error:
        raise UserError(f"The model's output for {', '.join(names)} cannot be scored: {one_line(error)}.") from error
    known = bool(scene.background.any())
    shares = foreground_share(scene, identities).tolist() if known else [math.nan] * len(names)
    backgrounds = background_identities(scene)
    maps = identities.cpu().numpy()
    for b, name in enumerate(names):
        about = _metadata(batches.dataset, int(batch["index"][b]))
        try:
            tally.evaluator.add(name, maps[b], truth[b], about, backgrounds[b])
        except ValueError as error:
            raise UserError(f"The model's output for {name} cannot be scored: {one_line(error)}.") from error
        tally.positions[name] = done + len(tally)
        tally.shares[name] = shares[b]
        if keep:
            tally.identities[name] = (maps[b], frozenset(backgrounds[b]))


def _metadata(dataset: Dataset[dict[str, Any]], index: int) -> ObjectMetadata | None:
    """What the data set knows of a video's objects, if it says anything (`P2D.meta`)."""
    while isinstance(dataset, Subset):
        dataset = dataset.dataset
    meta = getattr(dataset, "meta", None)
    return None if meta is None else p2d_metadata(meta(index))
