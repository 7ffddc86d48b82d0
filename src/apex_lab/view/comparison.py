"""Several models on the same clip: the input, then each model's segmentation and reconstruction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int64, UInt8
from PIL import Image
from scipy.optimize import linear_sum_assignment

from apex_lab.view.canvas import FAINT, GAP, INK, MARGIN, cell_size, enlarge, fit, font, save_png, sheet
from apex_lab.view.colors import colorize
from apex_lab.view.film import CELL, spread

MIN_OVERLAP = 0.1
"""Smallest IoU over the clip at which two segments count as the same object."""

BACKGROUND, NOTHING = -2, -1
"""Colours that are no object's."""

_LABELS = 190
_CAPTION = 30
_TIMES = 22
_GROUP = 10


@dataclass(frozen=True)
class Shown:
    """One model's output for a clip.

    Attributes:
        name: caption.
        segmentation: identity of every pixel; negative where there is none.
        background: which of these pixels are background.
        reconstruction: RGB.
        kind: of the segmentation, for its caption.
    """

    name: str
    segmentation: Int64[np.ndarray, "T H W"]
    background: Bool[np.ndarray, "T H W"]
    reconstruction: UInt8[np.ndarray, "T H W 3"]
    kind: str = "segmentation"


def comparison(
    path: Path,
    name: str,
    frames: UInt8[np.ndarray, "T H W 3"],
    models: Sequence[Shown],
    truth: Int64[np.ndarray, "T H W"] | None = None,
    columns: int = 8,
) -> None:
    """Draws a clip: rows input, ground truth where there is one, then segmentation and reconstruction of each model.

    An object has the colour of the true object that it overlaps most, without ground truth that of the first model's.

    Args:
        path: PNG to write.
        name: of the clip.
        frames: RGB.
        models: at least one, with arrays of the frames' size.
        truth: true labels, 0 is the background.
        columns: at most so many frames, evenly spaced.

    Raises:
        ValueError: no model, or one whose arrays have another size.
        UserError: the file cannot be written.
    """
    if not models:
        raise ValueError("models is empty, expected at least one")
    for model in models:
        if model.segmentation.shape != frames.shape[:3] or model.reconstruction.shape != frames.shape:
            raise ValueError(f"{model.name} has the size {model.segmentation.shape}, the clip {frames.shape[:3]}")
    painted = colours(models, truth)
    rows: list[tuple[str, str, np.ndarray]] = [("input", "", frames)]
    if truth is not None:
        rows.append(("ground truth", "", _paint(np.where(truth == 0, BACKGROUND, truth))))
    for model, labels in zip(models, painted, strict=True):
        rows.append((model.name, model.kind, _paint(labels)))
        rows.append(("", "reconstruction", model.reconstruction))
    save_png(path, _page(name, rows, spread(len(frames), columns)))


def colours(
    models: Sequence[Shown], truth: Int64[np.ndarray, "T H W"] | None = None
) -> list[Int64[np.ndarray, "T H W"]]:
    """The number of each pixel's colour: equal for objects of different models that match; see `comparison`."""
    found = []
    reference = None if truth is None else np.where(truth == 0, BACKGROUND, truth)
    for model in models:
        own = np.where(model.background, BACKGROUND, np.where(model.segmentation < 0, NOTHING, model.segmentation))
        labels = _renamed(own, reference)
        reference = labels if reference is None else reference
        found.append(labels)
    return found


def _renamed(
    own: Int64[np.ndarray, "T H W"], reference: Int64[np.ndarray, "T H W"] | None
) -> Int64[np.ndarray, "T H W"]:
    """Objects under the numbers of those of the reference that they match; others under numbers that are free."""
    objects = np.unique(own[own >= 0])
    if reference is None:
        names = dict(zip(objects.tolist(), range(len(objects)), strict=True))
    else:
        others = np.unique(reference[reference >= 0])
        names = _matches(own, objects, reference, others)
        free = (number for number in range(len(objects) + len(others) + 1) if number not in set(others.tolist()))
        names |= {each: next(free) for each in objects.tolist() if each not in names}
    renamed = own.copy()
    for each, number in names.items():
        renamed[own == each] = number
    return renamed


def _matches(own: np.ndarray, objects: np.ndarray, reference: np.ndarray, others: np.ndarray) -> dict[int, int]:
    both = np.array([[np.count_nonzero((own == a) & (reference == b)) for b in others] for a in objects])
    if not both.size:
        return {}
    area_own = np.array([np.count_nonzero(own == a) for a in objects])[:, None]
    area_other = np.array([np.count_nonzero(reference == b) for b in others])[None]
    iou = both / np.maximum(area_own + area_other - both, 1)
    rows, columns = linear_sum_assignment(iou, maximize=True)
    return {int(objects[i]): int(others[j]) for i, j in zip(rows, columns, strict=True) if iou[i, j] >= MIN_OVERLAP}


def _paint(labels: Int64[np.ndarray, "T H W"]) -> UInt8[np.ndarray, "T H W 3"]:
    return colorize(labels, {BACKGROUND})


def _page(name: str, rows: Sequence[tuple[str, str, np.ndarray]], times: Sequence[int]) -> Image.Image:
    _, frame_height, frame_width, _ = rows[0][2].shape
    height, width = cell_size(frame_height, frame_width, CELL)
    tops: list[int] = []
    top = MARGIN + _CAPTION + _TIMES
    for group, _, _ in rows:
        top += _GROUP if group and tops else 0
        tops.append(top)
        top += height + GAP
    page, draw = sheet(2 * MARGIN + _LABELS + len(times) * (width + GAP) - GAP, top - GAP + MARGIN)
    caption = font(17, bold=True)
    draw.text((MARGIN, MARGIN), fit(name, page.width - 2 * MARGIN, caption), INK, caption)
    for column, t in enumerate(times):
        left = MARGIN + _LABELS + column * (width + GAP)
        draw.text((left + width // 2, MARGIN + _CAPTION + _TIMES - 6), f"t = {t}", FAINT, font(14), anchor="mb")
        for (_, _, pictures), place in zip(rows, tops, strict=True):
            page.paste(Image.fromarray(enlarge(pictures[t], (height, width))), (left, place))
    for (group, kind, _), place in zip(rows, tops, strict=True):
        middle, right = place + height // 2, MARGIN + _LABELS - 10
        if group:
            text = fit(group, _LABELS - 10, font(15, bold=True))
            draw.text((right, middle - 10 * bool(kind)), text, INK, font(15, bold=True), anchor="rm")
        draw.text((right, middle + 10 * bool(group)), kind, FAINT, font(14), anchor="rm")
    return page
