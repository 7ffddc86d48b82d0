"""PNGs that say who wrote them. Of the pictures in a folder, only such ones are ever removed."""

from __future__ import annotations

from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngInfo

SOFTWARE = "apex_lab"


def signature() -> PngInfo:
    """What `Image.save(..., pnginfo=signature())` writes beside the pixels."""
    info = PngInfo()
    info.add_text("Software", SOFTWARE)
    return info


def is_signed(path: Path) -> bool:
    """Whether a file is a PNG of ours."""
    try:
        with Image.open(path, formats=["PNG"]) as image:
            return image.info.get("Software") == SOFTWARE
    except (OSError, SyntaxError, ValueError):
        return False
