"""One video's prediction, and the way from soft masks to one identity per pixel (metrics.md sections 0 and 2.4)."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int64, Integer, Shaped

from apex_lab.base.errors import UserError
from apex_lab.metrics.evaluator import MAX_IDENTITY
from apex_lab.metrics.objects import ObjectMetadata
from apex_lab.scene import ABSENT

SUM_TOLERANCE = 1e-3
"""How far the masks of a pixel may sum from 1; ten times that in half precision."""


@dataclass(frozen=True)
class PredictedVideo:
    """A program's predictions for one video.

    Attributes:
        name: of the video.
        identities: identity of the winning segment at every pixel, >= 0.
        truth: true labels, 0 is the background.
        masks: soft masks, sum 1 over K; None where only the winners are known.
        ids: identity of each slot, -1 for an absent one.
        background_ids: which identities are background, where that is known.
        objects: metadata of the true objects.
    """

    name: str
    identities: Integer[np.ndarray, "T H W"]
    truth: Integer[np.ndarray, "T H W"] | None = None
    masks: Shaped[np.ndarray, "T K H W"] | None = None
    ids: Integer[np.ndarray, "T K"] | None = None
    background_ids: Collection[int] = ()
    objects: ObjectMetadata | None = None


def labels_of(video: PredictedVideo, truth: bool) -> Integer[np.ndarray, "T H W"]:
    """The predicted identities of a video, or its true labels.

    Raises:
        ValueError: it has no ground truth.
    """
    if not truth:
        return video.identities
    if video.truth is None:
        raise ValueError(f"video {video.name!r} has no ground truth to write")
    return video.truth


def hard_segmentation(
    masks: Shaped[np.ndarray, "T K H W"], ids: Integer[np.ndarray, "T K"], where: str
) -> Int64[np.ndarray, "T H W"]:
    """Identity of the winning slot at every pixel; ties go to the lowest slot.

    Args:
        masks: soft (or one-hot) masks, >= 0, sum 1 over K.
        ids: identity of each slot, unique in a frame; -1 for an absent slot, whose mask must win no pixel.
        where: file and video, for messages.

    Raises:
        UserError: masks or ids that break these rules.
    """
    if ids.shape != masks.shape[:2]:
        raise UserError(f"{where}: ids have the shape {ids.shape}, masks {masks.shape}; ids must be {masks.shape[:2]}")
    # Half precision would make ties that the stored values do not have.
    values = masks if masks.dtype.kind == "f" and masks.dtype.itemsize >= 4 else masks.astype(np.float32)
    _refuse(~np.isfinite(values), where, "a mask is {} at {}; masks must be finite numbers", values)
    _refuse(values < 0, where, "a mask is {} at {}; masks must not be negative", values)
    sums = values.sum(axis=1, dtype=np.float64)
    tolerance = SUM_TOLERANCE * (10 if masks.dtype == np.float16 else 1)
    _refuse(np.abs(sums - 1) > tolerance, where, "the masks sum to {} at {}; they must sum to 1 over the slots", sums)
    check_ids(ids, where)
    winner = values.argmax(axis=1)
    found = np.take_along_axis(ids.astype(np.int64)[:, :, None], winner.reshape(len(ids), 1, -1), axis=1)
    found = found.reshape(winner.shape)
    _refuse(
        found == ABSENT,
        where,
        "a slot with the id {} (absent) wins the pixel at {}; an absent slot must have a zero mask",
        found,
    )
    return found


def check_ids(ids: Integer[np.ndarray, "T K"], where: str) -> None:
    """Refuses ids below -1 or above 2^53, and an identity that two slots of a frame share."""
    _refuse(ids < ABSENT, where, "an id is {} at {}; ids are >= 0, and -1 for an absent slot", ids, "(frame, slot)")
    _refuse(ids > MAX_IDENTITY, where, "an id is {} at {}; ids end at 2^53", ids, "(frame, slot)")
    for frame, here in enumerate(ids):
        present, count = np.unique(here[here != ABSENT], return_counts=True)
        if (count > 1).any():
            raise UserError(
                f"{where}: frame {frame} has the id {present[count > 1][0]} more than once; "
                "an identity can be in one place only"
            )


def check_labels(truth: Integer[np.ndarray, "T H W"], where: str, ignore_label: int | None = None) -> None:
    """Refuses negative ground truth, and labels above 2^53, apart from the label that is to be ignored."""
    counted = np.ones(truth.shape, dtype=bool) if ignore_label is None else truth != ignore_label
    message = (
        "the ground truth is {} at {}; labels are >= 0, 0 is the background; scoring.ignore_label leaves pixels of one "
        "label out, whatever its number"
    )
    _refuse((truth < 0) & counted, where, message, truth)
    _refuse((truth > MAX_IDENTITY) & counted, where, "the ground truth is {} at {}; labels end at 2^53", truth)


def fit(
    prediction: Int64[np.ndarray, "T H W"], truth: Integer[np.ndarray, "T2 H2 W2"], resize: str | None, where: str
) -> Integer[np.ndarray, "T H W"]:
    """The ground truth in the size of the prediction.

    Args:
        prediction: identities.
        truth: true labels.
        resize: "truth" brings the ground truth to another size by nearest neighbour; None refuses another size.
        where: file and video, for messages.
    """
    if len(truth) != len(prediction):
        raise UserError(f"{where}: the prediction has {len(prediction)} frames, the ground truth {len(truth)}")
    if truth.shape == prediction.shape:
        return truth
    if resize != "truth":
        raise UserError(
            f"{where}: the prediction is {size_words(prediction)}, the ground truth {size_words(truth)}; set resize to "
            "'masks' (soft masks bilinearly to the ground truth's size) or 'truth' (by nearest neighbour, the reverse)"
        )
    rows, columns = (
        (np.arange(new) * old + old // 2) // new for new, old in zip(prediction.shape[1:], truth.shape[1:], strict=True)
    )
    return truth[:, rows[:, None], columns]


def resized(masks: Shaped[np.ndarray, "T K H W"], size: tuple[int, int]) -> Float[np.ndarray, "T K H2 W2"]:
    """Soft masks in another size, bilinearly."""
    tensor = torch.from_numpy(np.ascontiguousarray(masks, dtype=np.float32))
    return F.interpolate(tensor, size=size, mode="bilinear", align_corners=False).numpy()


def size_words(labels: Shaped[np.ndarray, "T H W"]) -> str:
    """Height x width, for messages."""
    return f"{labels.shape[-2]} x {labels.shape[-1]}"


def with_rest(
    place: Callable[[Int64[np.ndarray, "T H W"]], None], shape: tuple[int, int, int]
) -> Int64[np.ndarray, "T H W"]:
    """An identity map from segments that need not fill the image.

    Pixels of no segment become one more segment over the whole video, which is the background of a program that
    gives objects alone; its identity is one above the largest.

    Args:
        place: writes identities into a map of -1.
        shape: (T, H, W).
    """
    found = np.full(shape, ABSENT, dtype=np.int64)
    place(found)
    return np.where(found == ABSENT, found.max() + 1, found)


def _refuse(bad: np.ndarray, where: str, message: str, values: np.ndarray, axes: str = "") -> None:
    """Raises with the first bad value and its place, if there is one."""
    if not bad.any():
        return
    place = np.unravel_index(int(bad.argmax()), bad.shape)
    names = axes or ("(frame, slot, row, column)" if bad.ndim == 4 else "(frame, row, column)")
    indices = ", ".join(str(int(i)) for i in place)
    value = values[place]
    shown = f"{value:.6g}" if isinstance(value, np.floating) else str(value)
    raise UserError(f"{where}: " + message.format(shown, f"{names} = ({indices})"))
