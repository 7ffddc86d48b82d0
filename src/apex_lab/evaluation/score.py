"""From a model and batches to scores, one batch in memory at a time: the one scoring path, of validation too."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor
from torch.utils.data import DataLoader, Subset

from apex_lab.base import interrupts
from apex_lab.base.errors import UserError
from apex_lab.base.progress import Meter
from apex_lab.base.validation import one_line
from apex_lab.data.video_set import Item, VideoSet
from apex_lab.evaluation.partial import Parts, Predicted
from apex_lab.evaluation.scoring import ScoringPart
from apex_lab.formats.video import fit
from apex_lab.inference.predictor import Batch, Predictor
from apex_lab.metrics import Evaluator, EvaluatorSettings, background_identities, scene_identities
from apex_lab.scene import ABSENT, Scene

Batches = DataLoader[Item]

Onlooker = Callable[[Batch, Scene], None]
"""Sees a batch and the model's scene of it."""


@dataclass
class Tally:
    """Scores of some videos.

    Attributes:
        evaluator: the scores; holds no video of an unlabelled set.
        positions: video's name -> its place in the split, in the order of scoring.
        frames: video's name -> how many it has.
        shares, present, terms: video's name -> as in `Predicted`.
    """

    evaluator: Evaluator
    positions: dict[str, int] = field(default_factory=dict)
    frames: dict[str, int] = field(default_factory=dict)
    shares: dict[str, float] = field(default_factory=dict)
    present: dict[str, float] = field(default_factory=dict)
    terms: dict[str, dict[str, float]] = field(default_factory=dict)

    @staticmethod
    def empty(settings: EvaluatorSettings) -> Tally:
        """No video yet."""
        return Tally(Evaluator(settings))

    def add(self, predicted: Predicted, videos: VideoSet, truth: np.ndarray | None = None) -> None:
        """Scores one video.

        Args:
            predicted: of the video.
            videos: where its ground truth and metadata are.
            truth: (T, H, W) its labels; None reads them from `videos`.

        Raises:
            UserError: the prediction cannot be scored.
        """
        name = predicted.name
        if videos.labelled:
            labels = videos[predicted.position]["segmentation"].numpy() if truth is None else truth
            # scoring.resize = truth: no other identities have another size
            labels = fit(predicted.identities, labels, "truth", name)
            about = videos.metadata(predicted.position)
            try:
                self.evaluator.add(name, predicted.identities, labels, about, set(predicted.backgrounds))
            except ValueError as error:
                raise UserError(f"The model's output for {name} cannot be scored: {one_line(error)}.") from error
        self.positions[name] = predicted.position
        self.frames[name] = len(predicted.identities)
        self.shares[name], self.present[name] = predicted.share, predicted.present
        self.terms[name] = predicted.terms

    def merge(self, other: Tally) -> None:
        """Takes over the videos of another tally."""
        self.evaluator.merge(other.evaluator)
        self.positions.update(other.positions)
        self.frames.update(other.frames)
        self.shares.update(other.shares)
        self.present.update(other.present)
        self.terms.update(other.terms)

    def mean_terms(self) -> dict[str, float]:
        """Loss terms, averaged over videos in the order of the split."""
        names = sorted(self.positions, key=lambda name: self.positions[name])
        keys = self.terms[names[0]] if names else {}
        return {key: math.fsum(self.terms[name][key] for name in names) / len(names) for key in keys}

    def mean_share(self) -> float | None:
        """Share of pixels given to objects, averaged over videos; None for a model without a background."""
        known = [share for share in self.shares.values() if not math.isnan(share)]
        return math.fsum(known) / len(known) if known else None

    def mean_present(self) -> float:
        """Objects present in a frame, averaged over videos; NaN without any."""
        return math.fsum(self.present.values()) / len(self) if len(self) else math.nan

    def __len__(self) -> int:
        return len(self.positions)


def score(predictor: Predictor, batches: Batches, scoring: ScoringPart, parts: Parts | None = None) -> Tally:
    """Scores every video; what stands in `parts` is not predicted again.

    Args:
        predictor: the model.
        batches: whole videos in order.
        scoring: how.
        parts: where predictions are kept; None keeps none.

    Raises:
        UserError: the model's output cannot be scored; names the video.
    """
    tally = Tally.empty(scoring.settings(predictor.model.tracks))
    videos = video_set(batches)
    for predicted in parts or ():
        tally.add(predicted, videos)
    fresh: list[Predicted] = []
    with Meter("video", length(batches), len(tally)) as meter:
        for batch in _rest(batches, len(tally)):
            fresh += add_batch(tally, predictor, batch, videos, scoring)
            meter.show(len(tally))
            interrupts.check()
            if parts is not None and len(fresh) >= parts.interval:
                parts.save(fresh)
                fresh = []
    if parts is not None and fresh:
        parts.save(fresh)
    return tally


def add_batch(
    tally: Tally,
    predictor: Predictor,
    batch: Batch,
    videos: VideoSet,
    scoring: ScoringPart,
    onlookers: Sequence[Onlooker] = (),
) -> list[Predicted]:
    """Predicts and scores one batch; returns the predictions."""
    found = list(predict(predictor, batch, scoring, onlookers))
    for b, predicted in enumerate(found):
        tally.add(predicted, videos, batch["segmentation"][b].cpu().numpy() if videos.labelled else None)
    return found


def predict(
    predictor: Predictor, batch: Batch, scoring: ScoringPart, onlookers: Sequence[Onlooker] = ()
) -> Iterator[Predicted]:
    """The model's output for each video of a batch.

    Raises:
        UserError: pixels that belong to no identity.
    """
    to_truth = scoring.resize == "masks"
    scene = predictor(batch, full_size=to_truth)
    for look in onlookers:
        look(batch, scene)
    labels = batch.get("segmentation")
    size = None if not to_truth else tuple(batch["video"].shape[-2:] if labels is None else labels.shape[-2:])
    try:
        identities = scene_identities(scene, size, scoring.min_presence, scoring.presence_after)
    except ValueError as error:
        raise UserError(f"The model's output for {batch['name'][0]} cannot be scored: {one_line(error)}.") from error
    backgrounds = background_identities(scene)
    shares = foreground_share(backgrounds, identities).tolist() if bool(scene.background.any()) else None
    present = ((scene.presence >= scoring.min_presence) & (scene.ids != ABSENT) & ~scene.background).float().sum(-1)
    terms = {name: values.float().tolist() for name, values in scene.terms.items()}
    maps = identities.cpu().numpy()
    for b, name in enumerate(batch["name"]):
        yield Predicted(
            name=name,
            position=int(batch["index"][b]),
            identities=maps[b],
            backgrounds=frozenset(backgrounds[b]),
            share=math.nan if shares is None else shares[b],
            present=float(present[b].mean()),
            terms={key: values[b] for key, values in terms.items()},
        )


def foreground_share(backgrounds: Sequence[set[int]], identities: Int[Tensor, "B T H W"]) -> Tensor:
    """Share of a video's pixels that the model gives to objects, not to its background, (B,)."""
    given = [
        torch.isin(video, video.new_tensor(sorted(ids))) for video, ids in zip(identities, backgrounds, strict=True)
    ]
    return torch.stack([1.0 - background.float().mean() for background in given])


def length(batches: Batches) -> int:
    """How many videos there are."""
    return len(batches.dataset)  # type: ignore[arg-type]


def video_set(batches: DataLoader[Any]) -> VideoSet:
    """The set that a loader reads."""
    data = batches.dataset
    while isinstance(data, Subset):
        data = data.dataset
    assert isinstance(data, VideoSet)
    return data


def _rest(batches: Batches, done: int) -> Batches:
    """The batches after the first `done` videos."""
    if done == 0:
        return batches
    return DataLoader(
        Subset(batches.dataset, range(done, length(batches))),
        batch_size=batches.batch_size,
        num_workers=batches.num_workers,
        pin_memory=batches.pin_memory,
        collate_fn=batches.collate_fn,
    )
