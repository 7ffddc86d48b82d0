"""What is drawn on the objects: texture coordinates over the scans and a picture per class."""

from __future__ import annotations

import numpy as np
from PIL import Image

from sims.objects import Projection

COLOURS: dict[str, tuple[int, int, int]] = {
    "master_chef_can": (30, 60, 140),
    "cracker_box": (190, 30, 40),
    "sugar_box": (240, 220, 60),
    "tomato_soup_can": (210, 60, 50),
    "mustard_bottle": (235, 190, 20),
    "pudding_box": (120, 70, 40),
    "potted_meat_can": (60, 60, 160),
    "banana": (240, 210, 60),
    "apple": (180, 30, 30),
    "pear": (150, 180, 70),
    "orange": (240, 140, 30),
    "bleach_cleanser": (235, 240, 245),
    "mug": (200, 50, 90),
    "foam_brick": (160, 60, 50),
}


def draw(name: str) -> Image.Image:
    """The picture of one class."""
    return Image.new("RGB", (8, 8), COLOURS[name])


def texture_coordinates(vertices: np.ndarray, triangles: np.ndarray, projection: Projection) -> np.ndarray:
    """(F, 3, 2) per corner in [0, 1], v upwards."""
    return np.full((len(triangles), 3, 2), 0.5)
