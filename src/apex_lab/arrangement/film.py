"""A scenario as a video: the camera's view with masks and matches drawn in, the goal beside it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from apex_lab.view.canvas import FAINT, GAP, INK, MARGIN, PAPER, cell_size, enlarge, fit, font, sheet
from apex_lab.view.colors import overlay
from apex_lab.view.movie import mp4
from sims.arrangement.types import Detection, Frame

CELL = 384
"""Smallest width of a panel, in pixels."""
UNMATCHED = 100
"""Identities from here on are detections without a partner: their colours are none of the first ones."""
LAST_S = 1.5
"""Seconds that the last frame stands."""
_LINE = 22


@contextlib.contextmanager
def filming(path: Path, name: str, fps: int) -> Iterator[Callable[[Frame], None]]:
    """What an episode calls for each frame; the video is whole at the end, or not there.

    Args:
        path: of the MP4.
        name: of the scenario.
        fps: frames per second of the episode and of the video.

    Raises:
        UserError: the file cannot be written, or this system has no ffmpeg.
    """
    last: Image.Image | None = None
    with mp4(path, fps) as add:

        def on_frame(frame: Frame) -> None:
            nonlocal last
            last = drawn(frame, name)
            add(last)

        yield on_frame
        for _ in range(round(LAST_S * fps) if last is not None else 0):
            assert last is not None
            add(last)


def drawn(frame: Frame, name: str) -> Image.Image:
    """One frame: what the camera sees with the last detections, the goal with its own, and what is being done.

    Detections that are matched have one colour and one number on both sides; those without a partner have none of
    them and are marked "?".
    """
    current = {i: number for number, (i, _) in enumerate(frame.matches)}
    goal = {j: number for number, (_, j) in enumerate(frame.matches)}
    rows, columns = frame.view.rgb.shape[:2]
    height, width = cell_size(rows, columns, CELL)
    page, draw = sheet(_even(2 * MARGIN + 2 * width + GAP), _even(2 * MARGIN + 2 * _LINE + height))
    draw.text((MARGIN, MARGIN), f"scenario {name}", INK, font(14, bold=True))
    time = f"{frame.time_s:.1f} s"
    draw.text((page.width - MARGIN, MARGIN), time, FAINT, font(14), anchor="ra")
    draw.text((page.width // 2, MARGIN), fit(frame.note, width, font(14)), INK, font(14), anchor="ma")
    sides = (
        ("camera, last detections", frame.view.rgb, frame.detections, current),
        ("goal", frame.goal.rgb, frame.goal_detections, goal),
    )
    for number, (title, rgb, found, partners) in enumerate(sides):
        left, top = MARGIN + number * (width + GAP), MARGIN + _LINE
        page.paste(panel(rgb, found, partners, (height, width)), (left, top))
        draw.text((left, top + height + 4), title, FAINT, font(14))
    return page


def panel(
    rgb: np.ndarray, found: Sequence[Detection], partners: Mapping[int, int], size: tuple[int, int]
) -> Image.Image:
    """An image with the masks of detections laid over it, each with the number of its match.

    Args:
        rgb: (H, W, 3) uint8.
        found: detections in it.
        partners: index of a detection -> number of its match.
        size: (height, width) in pixels of the picture.
    """
    labels = np.full(rgb.shape[:2], -1)
    for i, one in enumerate(found):
        labels[one.mask] = partners.get(i, UNMATCHED + i)
    picture = Image.fromarray(overlay(enlarge(rgb, size), enlarge(labels, size), (), opacity=0.3))
    draw = ImageDraw.Draw(picture)
    scale = size[0] / rgb.shape[0]
    for i, one in enumerate(found):
        if one.mask.any():
            row, column = (np.argwhere(one.mask).mean(axis=0) + 0.5) * scale
            text = str(partners[i] + 1) if i in partners else "?"
            draw.text((column, row), text, PAPER, font(18, bold=True), anchor="mm", stroke_width=3, stroke_fill=INK)
    return picture


def _even(side: int) -> int:
    """H.264 in yuv420p wants even sides."""
    return side + side % 2
