"""The catalogue of household objects: YCB scan, mass, resting orientations and texture layout of each."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

from sims.textures import Projection

Rest = tuple[str, float, float]
"""Name, roll and pitch in radians of a resting orientation."""

UPRIGHT: Rest = ("upright", 0.0, 0.0)
ON_BACK: Rest = ("on_back", pi / 2, 0.0)
ON_SIDE: Rest = ("on_side", 0.0, pi / 2)
UPSIDE_DOWN: Rest = ("upside_down", pi, 0.0)


@dataclass(frozen=True)
class Entry:
    """One class of objects.

    Attributes:
        name: short name, used in labels and file names.
        ycb: identifier in the YCB Object and Model Set.
        mass_kg: as measured by the makers of the set (Calli et al. 2015); None: unknown.
        projection: how texture coordinates are assigned to the scan.
        rests: orientations of the object frame (z up as scanned, x along the longer horizontal side).
        faces: triangles of the drawn copy, of 16,384 in the scan.
        convex: False for shapes whose collision body is split into several convex parts.
    """

    name: str
    ycb: str
    mass_kg: float | None
    projection: Projection
    rests: tuple[Rest, ...]
    faces: int = 500
    convex: bool = True


CATALOGUE: tuple[Entry, ...] = (
    Entry("master_chef_can", "002_master_chef_can", 0.414, "can", (UPRIGHT, ON_BACK)),
    Entry("cracker_box", "003_cracker_box", 0.411, "box", (UPRIGHT, ON_BACK, ON_SIDE), faces=300),
    Entry("sugar_box", "004_sugar_box", 0.514, "box", (UPRIGHT, ON_BACK, ON_SIDE), faces=300),
    Entry("tomato_soup_can", "005_tomato_soup_can", 0.349, "can", (UPRIGHT, ON_BACK)),
    Entry("mustard_bottle", "006_mustard_bottle", 0.603, "can", (UPRIGHT, ON_BACK)),
    Entry("pudding_box", "008_pudding_box", 0.187, "box", (UPRIGHT, ON_BACK, ON_SIDE), faces=300),
    Entry("potted_meat_can", "010_potted_meat_can", 0.370, "box", (UPRIGHT, ON_BACK)),
    Entry("banana", "011_banana", 0.066, "length", (UPRIGHT,), faces=450, convex=False),
    Entry("apple", "013_apple", 0.068, "round", (UPRIGHT,)),
    Entry("pear", "016_pear", 0.049, "length", (UPRIGHT,)),
    Entry("orange", "017_orange", 0.047, "round", (UPRIGHT,)),
    Entry("bleach_cleanser", "021_bleach_cleanser", 1.131, "can", (UPRIGHT, ON_BACK)),
    Entry("mug", "025_mug", 0.118, "can", (UPRIGHT, UPSIDE_DOWN, ON_BACK), faces=600, convex=False),
    Entry("foam_brick", "061_foam_brick", 0.028, "box", (UPRIGHT, ON_BACK, ON_SIDE), faces=300),
)
