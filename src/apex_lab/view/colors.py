"""One colour per identity, and overlays in it.

The first six colours are Okabe and Ito's ("Color Universal Design", 2008) without black and blue; the others were
chosen to lie far from them and from each other, for normal vision and for simulated protanopia and deuteranopia.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from jaxtyping import Bool, Float, Int, Integer, UInt8

PALETTE = (
    "#56b4e9",
    "#e69f00",
    "#009e73",
    "#f0e442",
    "#d55e00",
    "#cc79a7",
    "#694bff",
    "#5eea8f",
    "#2d69c3",
    "#a5f3fc",
    "#d21e3c",
    "#b4ff78",
    "#875a96",
    "#ff4b78",
    "#3c783c",
    "#f7b58a",
)
"""Colour of the identities 0, 1, 2, ...; beyond its end it repeats in lighter, then in darker tones."""

BACKGROUND_COLOR = (42, 46, 53)
"""Dark grey: components that are background, and the truth's label 0."""

NOTHING_COLOR = (0, 0, 0)
"""Black: pixels without an identity."""

Color = tuple[int, int, int]

_TONES = ((1.0, 0), (0.55, 255), (0.6, 0), (0.3, 255))
"""(share of the colour, tone it is mixed with) of the palette's repetitions."""


def color_of(identity: int) -> Color:
    """RGB in 0 .. 255 of an identity; the same in every picture. Negative identities are `NOTHING_COLOR`."""
    if identity < 0:
        return NOTHING_COLOR
    round_, index = divmod(identity, len(PALETTE))
    share, tone = _TONES[round_ % len(_TONES)]
    red, green, blue = (int(PALETTE[index][i : i + 2], 16) for i in (1, 3, 5))
    return (_mix(red, tone, share), _mix(green, tone, share), _mix(blue, tone, share))


def colorize(segmentation: Int[np.ndarray, "*S"], background: Collection[int]) -> UInt8[np.ndarray, "*S 3"]:
    """Paints each pixel in the colour of its identity, the `background` identities in `BACKGROUND_COLOR`."""
    identities, place = np.unique(segmentation, return_inverse=True)
    colors = [BACKGROUND_COLOR if int(i) in background else color_of(int(i)) for i in identities]
    return np.array(colors, dtype=np.uint8)[place.reshape(segmentation.shape)]


def overlay(
    picture: UInt8[np.ndarray, "H W 3"],
    segmentation: Int[np.ndarray, "H W"],
    background: Collection[int],
    opacity: float = 0.45,
    width: int = 2,
) -> UInt8[np.ndarray, "H W 3"]:
    """Lays the colours of the objects over a picture, with an outline of `width` pixels in full colour.

    The background stays as it is.
    """
    objects = (segmentation >= 0) & ~np.isin(segmentation, list(background))
    paint = colorize(segmentation, background)
    alpha = np.where(objects & outline(segmentation, width), 1.0, opacity * objects)[..., None]
    return np.rint(alpha * paint + (1 - alpha) * picture).astype(np.uint8)


def outline(segmentation: Integer[np.ndarray, "H W"], width: int = 1) -> Bool[np.ndarray, "H W"]:
    """Pixels less than `width` steps (up, down, left, right) away from one whose neighbour has another identity."""
    edge = np.zeros(segmentation.shape, dtype=bool)
    _spread(edge, segmentation[1:] != segmentation[:-1], segmentation[:, 1:] != segmentation[:, :-1])
    for _ in range(width - 1):
        _spread(edge, edge[1:] | edge[:-1], edge[:, 1:] | edge[:, :-1])
    return edge


def _spread(edge: np.ndarray, vertical: np.ndarray, horizontal: np.ndarray) -> None:
    """Marks both pixels of each marked pair of neighbours."""
    edge[1:] |= vertical
    edge[:-1] |= vertical
    edge[:, 1:] |= horizontal
    edge[:, :-1] |= horizontal


def rgb8(picture: Float[np.ndarray, "*S"]) -> UInt8[np.ndarray, "*S"]:
    """Colours in [0, 1] to 0 .. 255; what lies outside is cut off, NaN becomes 0."""
    return np.rint(np.nan_to_num(picture, nan=0.0, posinf=1.0, neginf=0.0).clip(0, 1) * 255).astype(np.uint8)


def _mix(channel: int, tone: int, share: float) -> int:
    return round(share * channel + (1 - share) * tone)
