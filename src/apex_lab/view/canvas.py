"""Shared by all drawings: fonts, cells, writing."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import IO

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from apex_lab.base.files import make_folder, replacing
from apex_lab.base.signed import signature
from apex_lab.view.colors import Color

PAPER: Color = (255, 255, 255)
INK: Color = (31, 35, 40)
FAINT: Color = (120, 128, 138)
GAP = 4
"""Pixels between neighbouring cells."""
MARGIN = 12
"""Pixels around a picture."""


@cache
def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans as matplotlib ships it, so that a picture is the same on every system."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)


def fit(text: str, width: int, typeface: ImageFont.FreeTypeFont) -> str:
    """The text, cut with an ellipsis if it is wider than `width` pixels."""
    if typeface.getlength(text) <= width:
        return text
    while text and typeface.getlength(text + "…") > width:
        text = text[:-1]
    return text.rstrip() + "…"


def cell_size(height: int, width: int, target: int) -> tuple[int, int]:
    """(height, width) in pixels of an image magnified by the smallest whole number that makes it `target` wide."""
    scale = max(1, -(-target // width))
    return height * scale, width * scale


def enlarge(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W) or (H, W, C) resized to (height, width) = `size` without smoothing: no value changes."""
    height, width = picture.shape[:2]
    rows = (np.arange(size[0]) * 2 + 1) * height // (2 * size[0])
    columns = (np.arange(size[1]) * 2 + 1) * width // (2 * size[1])
    return picture[rows[:, None], columns]


def sheet(width: int, height: int) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    """An empty page."""
    page = Image.new("RGB", (width, height), PAPER)
    return page, ImageDraw.Draw(page)


def save_png(path: Path, page: Image.Image) -> None:
    """Writes a PNG; equal pictures have equal bytes.

    Raises:
        UserError: the file cannot be written.
    """
    with picture_file(path) as file:
        page.save(file, format="PNG", optimize=True, pnginfo=signature())


@contextlib.contextmanager
def picture_file(path: Path) -> Iterator[IO[bytes]]:
    """A file to write in place of `path`, whose folder is made: never half a picture under its name.

    Raises:
        UserError: the file cannot be written.
    """
    make_folder(path.parent)
    with replacing(path) as file:
        yield file
