"""Movies: several videos side by side with a model's output for them, as MP4 and as GIF."""

from __future__ import annotations

import contextlib
import math
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from apex_lab.base.files import unwritable
from apex_lab.view.canvas import FAINT, GAP, INK, MARGIN, cell_size, fit, font, picture_file, sheet
from apex_lab.view.encoder import Mp4, ffmpeg
from apex_lab.view.item import Clip, Item

CELL = 160
"""Smallest width of a panel, in pixels."""
VIDEOS_PER_PAGE = 3
_CAPTION = 24
_HEADING = 24


def movie(path: Path, items: Sequence[Item], fps: float = 5.0) -> None:
    """Plays videos, three at a time below each other, with the columns input, reconstruction, masks, ground truth.

    A video that is shorter than its neighbours stays at its last frame. Every frame bears its number.

    Args:
        path: what to write; `.mp4` (H.264, yuv420p, playable in every browser) or `.gif` (loops for ever).
        items: at least one; either all with ground truth or none.
        fps: frames per second.

    Raises:
        ValueError: another ending, no item, or items that do not fit each other.
        UserError: the file cannot be written, or this system has no ffmpeg.
    """
    if not items:
        raise ValueError("items is empty, expected at least one video")
    clips = [Clip(item) for item in items]
    if len({clip.rows for clip in clips}) > 1:
        raise ValueError("items are partly with and partly without segmentation, expected all or none")
    if path.suffix == ".mp4":
        with mp4(path, fps) as add:
            for frame in _frames(clips):
                add(frame)
    elif path.suffix == ".gif":
        _write_gif(path, clips, fps)
    else:
        raise ValueError(f"path is {str(path)!r}, expected a name that ends in .mp4 or .gif")


def _pages(clips: Sequence[Clip]) -> list[Sequence[Clip]]:
    """Splits the videos into as few pages as needed, of about equal size."""
    rows = math.ceil(len(clips) / math.ceil(len(clips) / VIDEOS_PER_PAGE))
    return [clips[i : i + rows] for i in range(0, len(clips), rows)]


def _frames(clips: Sequence[Clip]) -> Iterator[Image.Image]:
    """All frames of all pages, of one and the same even size."""
    pages = _pages(clips)
    columns = [name for name in clips[0].rows if name != "masks on input"]
    sizes = [cell_size(*clip.size, CELL) for clip in clips]
    height, width = max(size[0] for size in sizes), max(size[1] for size in sizes)
    page_width = 2 * MARGIN + len(columns) * (width + GAP) - GAP
    page_height = 2 * MARGIN + _HEADING + len(pages[0]) * (_CAPTION + height + GAP)
    for page in pages:
        for t in range(max(len(clip) for clip in page)):
            # H.264 in yuv420p wants even sides
            picture, draw = sheet(page_width + page_width % 2, page_height + page_height % 2)
            for i, name in enumerate(columns):
                middle = MARGIN + i * (width + GAP) + width // 2
                draw.text((middle, MARGIN), name, INK, font(15), anchor="mt")
            for row, clip in enumerate(page):
                now = min(t, len(clip) - 1)
                top = MARGIN + _HEADING + row * (_CAPTION + height + GAP)
                time = f"t = {now} of {len(clip) - 1}"
                room = page_width - 2 * MARGIN - int(font(14).getlength(time)) - 20
                draw.text((MARGIN, top), fit(clip.name, room, font(14, bold=True)), INK, font(14, bold=True))
                draw.text((page_width - MARGIN, top), time, FAINT, font(14), anchor="ra")
                size = cell_size(*clip.size, CELL)
                for i, name in enumerate(columns):
                    panel = Image.fromarray(clip.panel(name, now, size))
                    picture.paste(panel, (MARGIN + i * (width + GAP), top + _CAPTION))
            yield picture


@contextlib.contextmanager
def mp4(path: Path, fps: float) -> Iterator[Callable[[Image.Image], None]]:
    """A movie to add frames to, all of one size; it is put in place of `path` at the end, if it is whole.

    Args:
        path: what to write: H.264, yuv420p, playable in every browser.
        fps: frames per second.

    Raises:
        UserError: the file cannot be written, or this system has no ffmpeg.
    """
    ffmpeg()
    try:
        # ffmpeg needs a file name to write to
        with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as opened:
            part = Path(folder) / path.name
            made: list[Mp4] = []

            def add(frame: Image.Image) -> None:
                if not made:
                    made.append(opened.enter_context(Mp4(part, (frame.height, frame.width), fps)))
                made[0].add(np.asarray(frame))

            yield add
            opened.close()
            with picture_file(path) as file, open(part, "rb") as whole:
                shutil.copyfileobj(whole, file)
    except OSError as error:
        raise unwritable(path, error) from error


def _write_gif(path: Path, clips: Sequence[Clip], fps: float) -> None:
    frames = list(_frames(clips))
    palette = _common_palette(frames)
    pictures = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    with picture_file(path) as file:
        pictures[0].save(
            file,
            format="GIF",
            save_all=True,
            append_images=pictures[1:],
            duration=max(20, round(100 / fps) * 10),  # GIF counts in hundredths of a second
            loop=0,
            optimize=False,
        )


def _common_palette(frames: Sequence[Image.Image]) -> Image.Image:
    """One palette for all frames, so that colours do not flicker."""
    tiles: list[UInt8[np.ndarray, "h w 3"]] = [np.asarray(frame)[::2, ::2] for frame in frames]
    return Image.fromarray(np.concatenate(tiles)).quantize(256, method=Image.Quantize.MEDIANCUT)
