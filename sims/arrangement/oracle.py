"""Perception that reads the simulator's labels: the controller's own quality."""

from __future__ import annotations

import numpy as np

from sims.arrangement.types import Detection, View
from sims.objects import CATALOGUE
from sims.stage import FIRST_OBJECT_ID

CLASSES = tuple(entry.name for entry in CATALOGUE)


def perceive(view: View) -> list[Detection]:
    """One detection per visible object: its mask, presence 1, its class as one-hot appearance (14,)."""
    assert view.truth is not None, "the oracle needs View.truth"
    found = []
    for number, name in enumerate(view.truth.classes):
        mask = view.truth.segmentation == FIRST_OBJECT_ID + number
        if mask.any():
            found.append(Detection(mask, 1.0, np.eye(len(CLASSES))[CLASSES.index(name)]))
    return found
