"""The images that GENESIS-V2 cuts from the two front cameras: two cameras, seven square windows each.

A window of the 600 x 960 image is cut out, then resized by Pillow's bilinear filter, which averages over all pixels
that fall into one when it shrinks. PyTorch's `interpolate` without `antialias=True` is another filter.
"""

from __future__ import annotations

import io
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from apex_lab.data.sketchy.tfrecord import DamagedFileError

HEIGHT, WIDTH = 600, 960
"""Of the images of the front cameras, in pixels."""

CAMERAS = {"fl": "pixels/basket_front_left", "fr": "pixels/basket_front_right"}
"""Short name -> feature."""

TOP = {"fl": 71, "fr": 91}
"""First row of the region that windows are cut from, 448 rows x 672 columns."""

LEFT = 144
"""Its first column."""

WINDOWS = {
    "full": (0, 112, 448),
    **{f"c{3 * row + column}": (96 * row, 160 * column, 352) for row in (0, 1) for column in (0, 1, 2)},
}
"""Name -> first row and column within the region, and side."""


@dataclass(frozen=True)
class View:
    """One window of one camera.

    Attributes:
        camera: "fl" or "fr".
        window: "full" or "c0" to "c5".
    """

    camera: str
    window: str

    @property
    def name(self) -> str:
        """As in the names of files and videos: "fl_c3"."""
        return f"{self.camera}_{self.window}"

    @property
    def box(self) -> tuple[int, int, int, int]:
        """First column, first row, last column + 1, last row + 1 in the camera's image."""
        row, column, side = WINDOWS[self.window]
        left, top = LEFT + column, TOP[self.camera] + row
        return left, top, left + side, top + side


def all_views(windows: Collection[str] = tuple(WINDOWS)) -> list[View]:
    """The given windows of both cameras, in the order of `WINDOWS`."""
    return [View(camera, window) for window in WINDOWS if window in windows for camera in CAMERAS]


def open_image(jpeg: bytes) -> Image.Image:
    """An image whose header has been read and whose pixels have not been decoded.

    Raises:
        DamagedFileError: no JPEG, or not 600 x 960 in colour.
    """
    try:
        image = Image.open(io.BytesIO(jpeg), formats=["JPEG"])
    except Image.DecompressionBombError:  # it claims more pixels than any memory should hold
        raise DamagedFileError(f"an image of far more than {HEIGHT} x {WIDTH} pixels") from None
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError):
        raise DamagedFileError("no JPEG image") from None
    if (image.height, image.width, image.mode) != (HEIGHT, WIDTH, "RGB"):
        kind = "RGB" if image.mode == "RGB" else f"of mode {image.mode}"
        raise DamagedFileError(f"{image.height} x {image.width} pixels {kind}, not {HEIGHT} x {WIDTH} RGB")
    return image


def decoded(image: Image.Image) -> Image.Image:
    """The same image with its pixels.

    Raises:
        DamagedFileError: they are cut off or cannot be decoded.
    """
    try:
        image.load()
    except (OSError, SyntaxError, ValueError) as error:
        raise DamagedFileError(f"a damaged JPEG image ({error})") from None
    return image


def cut(image: Image.Image, view: View, side: int) -> UInt8[np.ndarray, "H W 3"]:
    """The view of a camera's image, `side` pixels high and wide."""
    return np.array(image.crop(view.box).resize((side, side), Image.Resampling.BILINEAR))
