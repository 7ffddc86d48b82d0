"""Pixel counts that true regions and predicted segments share: the one table every mask metric is computed from.

Legend: S point sets, N points of a set, G true regions (row 0 is the background), P predicted segments.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Int64, Integer
from torch import Tensor

BACKGROUND = 0
"""The label of the true background."""

PAD = -1
"""Stands in `Contingency.labels` and `.ids` for a row or column that a video does not use."""

Labels = Integer[Tensor, "B T H W"]
"""Predicted identities or true labels of B videos, >= 0."""

_MAX_SPAN = 2**16
"""Up to this label a table of flags finds the labels of a set; above it, sorting does."""


@dataclass(frozen=True)
class Contingency:
    """Shared pixel counts of B videos.

    Attributes:
        counts: pixels of frame t with true label `labels[b, g]` and predicted identity `ids[b, p]`.
        labels: the true label of each row, ascending; row 0 is always the background, `PAD` marks unused rows.
        ids: the predicted identity of each column, ascending; `PAD` marks unused columns.
    """

    counts: Int64[Tensor, "B T G P"]
    labels: Int64[Tensor, "B G"]
    ids: Int64[Tensor, "B P"]

    @property
    def empty_frames(self) -> Bool[Tensor, "B T"]:
        """Frames in which no object is visible."""
        return self.counts[:, :, 1:].sum(dim=(2, 3)) == 0


def contingency(prediction: Labels, truth: Labels, ignore_label: int | None = None) -> Contingency:
    """Counts shared pixels per frame; one identity has one column over the whole video.

    Args:
        prediction: predicted identities, >= 0; their values do not matter.
        truth: true labels, >= 0; 0 is the background.
        ignore_label: pixels of this true label are not counted, and neither it nor an identity that only such pixels
            have gets a row or column; it may be negative.

    Raises:
        ValueError: the shapes differ, are no (B, T, H, W), or hold no pixel; a label is negative.
        TypeError: labels that are no integers.
    """
    check_labels(prediction, truth, ignore_label)
    videos, frames = truth.shape[:2]
    ignored = None if ignore_label is None else (truth.long() == ignore_label).flatten(1)
    rows, labels = compact(truth.flatten(1).long(), keep_zero=True, left_out=ignored)
    columns, ids = compact(prediction.flatten(1).long(), left_out=ignored)
    n_rows, n_columns = labels.shape[1], ids.shape[1]
    frame = torch.arange(videos * frames, device=truth.device).view(videos, frames, 1)
    cell = (frame * n_rows + rows.view(videos, frames, -1)) * n_columns + columns.view(videos, frames, -1)
    counted = cell.flatten() if ignored is None else cell[~ignored.view_as(cell)]
    counts = torch.bincount(counted, minlength=videos * frames * n_rows * n_columns)
    return Contingency(counts.view(videos, frames, n_rows, n_columns), labels, ids)


def compact(
    labels: Int64[Tensor, "S N"], keep_zero: bool = False, left_out: Bool[Tensor, "S N"] | None = None
) -> tuple[Int64[Tensor, "S N"], Int64[Tensor, "S L"]]:
    """Renames the labels of every set to 0, 1, ... in ascending order.

    Args:
        labels: >= 0.
        keep_zero: label 0 keeps the name 0 in every set, whether it occurs or not.
        left_out: points whose label does not count as one that occurs; their new label means nothing. A set without
            any other point gets the label 0.

    Returns:
        the renamed labels, and the old label of each new one (L is the largest number of labels in a set, `PAD`
        fills the rest).
    """
    if left_out is not None:
        # Points that are left out take a label that the set has anyway.
        first = labels.masked_fill(left_out, torch.iinfo(torch.int64).max).amin(dim=1, keepdim=True)
        labels = torch.where(left_out, torch.where(left_out.all(dim=1, keepdim=True), 0, first), labels)
    largest = int(labels.max())
    if largest < _MAX_SPAN:
        names = torch.arange(largest + 1, device=labels.device)
    else:
        names = torch.cat([labels.new_zeros(1), labels.flatten()]).unique()
        labels = torch.searchsorted(names, labels)
    seen = torch.zeros(len(labels), len(names), dtype=torch.bool, device=labels.device).scatter_(1, labels, True)
    if keep_zero:
        seen[:, 0] = True
    rank = seen.cumsum(dim=1) - 1
    which_set, which_name = seen.nonzero(as_tuple=True)
    old = labels.new_full((len(labels), int(seen.sum(dim=1).max())), PAD)
    old[which_set, rank[which_set, which_name]] = names[which_name]
    return rank.gather(1, labels), old


def check_labels(prediction: Tensor, truth: Tensor, ignore_label: int | None = None) -> None:
    """Refuses label maps that no metric can read; see `contingency` for the errors."""
    for name, labels in (("prediction", prediction), ("truth", truth)):
        if labels.ndim != 4:
            raise ValueError(f"{name} must be (B, T, H, W), got shape {tuple(labels.shape)}")
        if labels.is_floating_point() or labels.is_complex() or labels.dtype == torch.bool:
            raise TypeError(f"{name} must hold integer labels, got {labels.dtype}")
    if prediction.shape != truth.shape:
        raise ValueError(
            f"prediction {tuple(prediction.shape)} and truth {tuple(truth.shape)} must have the same shape; "
            "bring the masks to the size of the truth before the argmax"
        )
    if truth.numel() == 0:
        raise ValueError(f"label maps of shape {tuple(truth.shape)} hold no pixel")
    known = truth if ignore_label is None else truth[truth.long() != ignore_label]
    smallest = int(known.min()) if known.numel() else 0
    if smallest < 0:
        raise ValueError(
            f"truth has the negative label {smallest}; labels are >= 0, 0 is the background; set ignore_label="
            f"{smallest} (scoring.ignore_label={smallest} on the command line) to leave such pixels out"
        )
    smallest = int(prediction.min())
    if smallest < 0:
        raise ValueError(
            f"prediction has a pixel with the identity {smallest}; every pixel must go to a segment with an identity "
            ">= 0 (an absent slot must have a zero mask, the background an identity of its own)"
        )
