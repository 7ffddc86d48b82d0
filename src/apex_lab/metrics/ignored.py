"""Pixels of the ground truth that are left out of every metric (metrics.md section 5)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Integer

VOID_LABELS = (255, 65535)
"""Numbers that mark unlabelled pixels by convention: the largest one of an 8-bit and of a 16-bit image."""


def ignored_pixels(truth: Integer[np.ndarray, "T H W"], ignore_label: int | None) -> Bool[np.ndarray, "T H W"] | None:
    """Where the truth has the label that is left out; None where no label is."""
    return None if ignore_label is None else truth == ignore_label


def likely_void(truth: Integer[np.ndarray, "T H W"]) -> int | None:
    """A label that looks like the mark of unlabelled pixels and not like an object.

    That is one of `VOID_LABELS` in a video that does not number its objects up to it.
    """
    for label in VOID_LABELS:
        if (truth == label).any() and not (truth == label - 1).any():
            return label
    return None
