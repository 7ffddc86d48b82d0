"""Film strips: frames from left to right, input, prediction and truth from top to bottom."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from apex_lab.view.canvas import FAINT, GAP, INK, MARGIN, cell_size, fit, font, save_png, sheet
from apex_lab.view.item import Clip, Item

CELL = 128
"""Smallest width of a frame, in pixels."""
_LABELS = 140
_CAPTION = 30
_TIMES = 22


def film_strip(path: Path, items: Sequence[Item], columns: int = 8) -> None:
    """Draws videos below each other, each with the rows input, reconstruction, masks, masks on input, ground truth.

    Masks have one colour per identity (`apex_lab.view.colors.color_of`) in all frames; background is dark grey.

    Args:
        path: PNG to write.
        items: at least one.
        columns: at most so many frames, evenly spaced from the first to the last.

    Raises:
        ValueError: no item, or one whose parts do not fit each other.
        UserError: the file cannot be written.
    """
    save_png(path, film_page(items, columns))


def film_page(items: Sequence[Item], columns: int = 8) -> Image.Image:
    """What `film_strip` draws, as a picture in memory.

    Raises:
        ValueError: no item, or one whose parts do not fit each other.
    """
    if not items:
        raise ValueError("items is empty, expected at least one video")
    return _stack([_strip(Clip(item), columns) for item in items])


def spread(frames: int, columns: int) -> list[int]:
    """At most `columns` frame numbers, evenly spaced, the first and the last among them."""
    return sorted({round(t) for t in np.linspace(0, frames - 1, min(frames, columns)).tolist()})


def _strip(clip: Clip, columns: int) -> Image.Image:
    """One video: caption, frame numbers, rows."""
    times = spread(len(clip), columns)
    height, width = cell_size(*clip.size, CELL)
    page, draw = sheet(
        2 * MARGIN + _LABELS + len(times) * (width + GAP) - GAP,
        2 * MARGIN + _CAPTION + _TIMES + len(clip.rows) * (height + GAP) - GAP,
    )
    caption = fit(clip.name, page.width - 2 * MARGIN, font(17, bold=True))
    draw.text((MARGIN, MARGIN), caption, INK, font(17, bold=True))
    top = MARGIN + _CAPTION + _TIMES
    for column, t in enumerate(times):
        left = MARGIN + _LABELS + column * (width + GAP)
        draw.text((left + width // 2, top - 6), f"t = {t}", FAINT, font(14), anchor="mb")
        for row, name in enumerate(clip.rows):
            page.paste(Image.fromarray(clip.panel(name, t, (height, width))), (left, top + row * (height + GAP)))
    for row, name in enumerate(clip.rows):
        middle = top + row * (height + GAP) + height // 2
        draw.text((MARGIN + _LABELS - 10, middle), name, INK, font(15), anchor="rm")
    return page


def _stack(strips: Sequence[Image.Image]) -> Image.Image:
    page, _ = sheet(max(strip.width for strip in strips), sum(strip.height for strip in strips))
    top = 0
    for strip in strips:
        page.paste(strip, (0, top))
        top += strip.height
    return page
