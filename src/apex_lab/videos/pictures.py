"""Pictures as 8-bit RGB, whatever their file holds."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageOps, UnidentifiedImageError

from apex_lab.base.errors import UserError
from apex_lab.base.order import natural_key
from apex_lab.base.validation import one_line, sentence

FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP", "PPM", "GIF", "AVIF", "JPEG2000")
"""Formats of Pillow that are read. Others are for drawings or start other programs (EPS)."""

_SUFFIXES = """
    .png .apng .jpg .jpeg .jpe .jfif .mpo .bmp .dib .tif .tiff .webp .ppm .pgm .pbm .pnm .gif .avif .jp2 .j2k
"""
SUFFIXES = frozenset(_SUFFIXES.split())
"""Endings of pictures in a folder; what such a file holds is found out from its content."""

_PAGED = ("GIF", "WEBP", "PNG", "TIFF", "AVIF")
"""Formats whose pages are frames. (Those of a JPEG are other versions of one photograph.)"""

_DAMAGE = (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError, MemoryError)
"""What Pillow raises for damaged files."""


def is_picture(path: Path) -> bool:
    """Whether the content of a file is that of a picture; its name does not count."""
    try:
        with _opened(path):
            return True
    except (UnidentifiedImageError, *_DAMAGE):
        return False


def pictures_in(folder: Path) -> list[Path]:
    """The pictures of a folder in natural order (2 before 10); hidden files and other files are passed over."""
    files = (file for file in folder.iterdir() if not file.name.startswith(".") and file.suffix.lower() in SUFFIXES)
    return sorted((file for file in files if file.is_file()), key=lambda file: natural_key(file.name))


def pages_of(path: Path) -> int:
    """How many frames a picture file has: more than one for an animation or a stack.

    Raises:
        UserError: it cannot be read.
    """
    try:
        with _opened(path) as image:
            return int(getattr(image, "n_frames", 1)) if image.format in _PAGED else 1
    except (UnidentifiedImageError, *_DAMAGE) as error:
        raise _unreadable(path, error) from error


def read_pages(path: Path, start: int = 0) -> Iterator[tuple[UInt8[np.ndarray, "H W 3"], float | None]]:
    """The frames of a picture file as RGB, each with the seconds that it is shown, where the file says so.

    Rotation by EXIF is applied. Grey becomes RGB; of 16 bits the upper 8 are kept; transparent pixels are laid over
    black.

    Args:
        path: the file.
        start: first frame.

    Raises:
        UserError: damaged, or a kind of picture that has no 8-bit form (floating point numbers).
    """
    try:
        with _opened(path) as image:
            pages = int(getattr(image, "n_frames", 1)) if image.format in _PAGED else 1
            for page in range(start, pages):
                if pages > 1:
                    image.seek(page)
                duration = image.info.get("duration")
                yield _rgb(image, path), (float(duration) / 1000 if duration else None)
    except (UnidentifiedImageError, *_DAMAGE) as error:
        raise _unreadable(path, error) from error


def _opened(path: Path) -> Image.Image:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of large pictures and odd tags; what is too large raises
        return Image.open(path, formats=FORMATS)


def _rgb(image: Image.Image, path: Path) -> UInt8[np.ndarray, "H W 3"]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        image.load()
        turned = ImageOps.exif_transpose(image)
    if turned.mode.startswith("I"):  # I;16 and, in other versions of Pillow, I for the same files
        return _of_integers(np.asarray(turned), path)
    if turned.mode == "F":
        raise UserError(f"{path} holds floating point numbers: save it as a picture of 8 or 16 bits.")
    if turned.has_transparency_data:
        turned = turned.convert("RGBA")
        turned = Image.alpha_composite(Image.new("RGBA", turned.size, (0, 0, 0, 255)), turned)
    return np.array(turned.convert("RGB"))


def _of_integers(values: np.ndarray, path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """Grey of 16 bits."""
    if values.min() < 0 or values.max() > 65535:
        raise UserError(f"{path} has grey values beyond 16 bits: save it as a picture of 8 or 16 bits.")
    return np.repeat((values.astype(np.uint16) >> 8).astype(np.uint8)[..., None], 3, axis=2)


def _unreadable(path: Path, error: BaseException) -> UserError:
    if isinstance(error, UnidentifiedImageError) or not str(error):
        return UserError(f"{path} is no picture that can be read, or it is damaged.")
    return UserError(sentence(f"{path} is damaged or cannot be read: {one_line(error)}"))
