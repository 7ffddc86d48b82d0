"""Colours: the same for the same identity, far enough apart for every eye, and laid where they belong."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from apex_lab.view.colors import BACKGROUND_COLOR, NOTHING_COLOR, PALETTE, color_of, colorize, outline, overlay, rgb8

# Machado, Oliveira and Fernandes (2009), severity 1, on linear RGB
VISION = {
    "normal": np.eye(3),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
}


def lab(color: tuple[int, int, int], vision: np.ndarray) -> np.ndarray:
    """CIELAB (D65) of an sRGB colour as seen by a kind of eye."""
    c = np.array(color) / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array(
        [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
    )
    x, y, z = to_xyz @ (vision @ linear).clip(0, 1) / [0.95047, 1.0, 1.08883]
    f = [np.cbrt(v) if v > 216 / 24389 else (24389 / 27 * v + 16) / 116 for v in (x, y, z)]
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize(
    ("vision", "identities", "least"),
    [("normal", 16, 20), ("normal", 6, 30), ("deuteranopia", 6, 17), ("protanopia", 6, 17)],
)
def test_first_identities_and_background_can_be_told_apart(vision: str, identities: int, least: float) -> None:
    colors = [lab(color_of(i), VISION[vision]) for i in range(identities)] + [lab(BACKGROUND_COLOR, VISION[vision])]
    assert min(np.linalg.norm(a - b) for a, b in combinations(colors, 2)) > least


def test_identities_have_fixed_and_different_colors() -> None:
    assert color_of(0) == (0x56, 0xB4, 0xE9)
    assert color_of(1) == (0xE6, 0x9F, 0x00)
    assert color_of(-1) == NOTHING_COLOR
    assert len({color_of(i) for i in range(4 * len(PALETTE))}) == 4 * len(PALETTE)
    assert color_of(4 * len(PALETTE)) == color_of(0)
    assert all(0 <= channel <= 255 for i in range(200) for channel in color_of(i))


def test_colorize_paints_identities_background_and_nothing() -> None:
    painted = colorize(np.array([[0, 5], [-1, 9]]), background={0, 9})
    assert painted.dtype == np.uint8
    assert painted.tolist() == [
        [list(BACKGROUND_COLOR), list(color_of(5))],
        [list(NOTHING_COLOR), list(BACKGROUND_COLOR)],
    ]


def test_overlay_tints_objects_outlines_them_and_leaves_the_rest() -> None:
    picture = np.full((9, 9, 3), 100, dtype=np.uint8)
    ids = np.zeros((9, 9), dtype=int)
    ids[2:7, 2:7] = 4
    laid = overlay(picture, ids, background={0}, opacity=0.5, width=1)
    color = np.array(color_of(4))
    assert (laid[ids == 0] == 100).all()
    assert (laid[2, 2:7] == color).all()
    np.testing.assert_allclose(laid[3:6, 3:6], np.broadcast_to((color + 100) / 2, (3, 3, 3)), atol=0.5)
    assert (overlay(picture, ids - 5, background=set())[ids == 0] == 100).all(), "pixels without identity stay"


def test_outline_has_its_width() -> None:
    ids = np.zeros((1, 10), dtype=int)
    ids[:, 5:] = 1
    assert np.flatnonzero(outline(ids)).tolist() == [4, 5]
    assert np.flatnonzero(outline(ids, 2)).tolist() == [3, 4, 5, 6]
    assert not outline(np.zeros((3, 3), dtype=int), 3).any()


def test_rgb8_cuts_off_and_rounds() -> None:
    assert rgb8(np.array([-1.0, 0.0, 0.5, 1.0, 2.0, np.nan, np.inf])).tolist() == [0, 0, 128, 255, 255, 0, 255]
