"""Frames of a long video with its objects painted on them; written for speed, as `colors.overlay` for pictures."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import cv2
import numpy as np
from jaxtyping import UInt8

from apex_lab.view.colors import BACKGROUND_COLOR, color_of, outline

UNSEEN = 255
"""Index of pixels that no model has seen."""

_OPACITY = 0.45
_DIM = 0.35


@cache
def index_palette() -> UInt8[np.ndarray, "256 3"]:
    """Colours of indices: 0 the background, 1 to 254 objects, `UNSEEN` white."""
    return np.array([BACKGROUND_COLOR, *(color_of(i) for i in range(1, UNSEEN)), (255, 255, 255)], dtype=np.uint8)


def annotated(
    image: UInt8[np.ndarray, "H W 3"], index: UInt8[np.ndarray, "H W"], names: Mapping[int, tuple[str, float, float]]
) -> UInt8[np.ndarray, "H W 3"]:
    """A frame with coloured objects, their outlines and names; what was not seen is dark.

    Args:
        image: RGB.
        index: as in `index_palette`.
        names: index -> text, and (x, y) of its middle in pixels.
    """
    paint = index_palette()[index]
    objects = (index > 0) & (index < UNSEEN)
    found = np.where(objects[..., None], cv2.addWeighted(image, 1 - _OPACITY, paint, _OPACITY, 0), image)
    thick = max(1, round(min(index.shape) / 250))
    edge = outline(index, thick) & objects
    found[edge] = paint[edge]
    unseen = index == UNSEEN
    if unseen.any():
        found[unseen] = (found[unseen] * _DIM).astype(np.uint8)
    scale = min(index.shape) / 600
    if scale >= 0.3:  # letters are larger than objects in smaller frames
        for text, x, y in names.values():
            _write(found, text, x, y, scale)
    return found


def _write(image: np.ndarray, text: str, x: float, y: float, scale: float) -> None:
    """White letters with a dark rim."""
    thick = max(1, round(2 * scale))
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)
    place = (round(x - width / 2), round(y + height / 2))
    for color, rim in (((20, 20, 20), thick + 2), ((255, 255, 255), thick)):
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, color, rim, cv2.LINE_AA)
