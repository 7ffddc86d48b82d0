"""Windows of the front cameras against the published coordinates, and the resizing against Pillow's."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from apex_lab.data.sketchy.views import CAMERAS, View, all_views, cut

# first and last row, by camera, and first and last column of each window in the 600 x 960 image
ROWS = {
    "fl": {"full": (71, 518), "top": (71, 422), "low": (167, 518)},
    "fr": {"full": (91, 538), "top": (91, 442), "low": (187, 538)},
}
PLACES = {
    "full": ("full", (256, 703)),
    "c0": ("top", (144, 495)),
    "c1": ("top", (304, 655)),
    "c2": ("top", (464, 815)),
    "c3": ("low", (144, 495)),
    "c4": ("low", (304, 655)),
    "c5": ("low", (464, 815)),
}


def test_there_are_fourteen_views() -> None:
    assert len(all_views()) == 14
    assert [view.name for view in all_views(("full", "c5"))] == ["fl_full", "fr_full", "fl_c5", "fr_c5"]


@pytest.mark.parametrize("camera", list(CAMERAS))
@pytest.mark.parametrize("window", list(PLACES))
def test_corners_of_a_window_are_corners_of_its_image(camera: str, window: str) -> None:
    """A block in each corner has its colour, and what lies one pixel outside is not seen."""
    which, (left, right) = PLACES[window]
    top, low = ROWS[camera][which]
    image = np.full((600, 960, 3), 255, np.uint8)  # outside: white
    image[top : low + 1, left : right + 1] = 0
    corners = {(0, 0): (200, 0, 0), (0, -1): (0, 200, 0), (-1, 0): (0, 0, 200), (-1, -1): (200, 200, 0)}
    for (row, column), colour in corners.items():
        rows = slice(top, top + 24) if row == 0 else slice(low - 23, low + 1)
        columns = slice(left, left + 24) if column == 0 else slice(right - 23, right + 1)
        image[rows, columns] = colour
    found = cut(Image.fromarray(image), View(camera, window), 128)
    assert found.shape == (128, 128, 3)
    for (row, column), colour in corners.items():
        assert tuple(found[row, column]) == colour
    middle = found[40:88]
    assert middle[:, 0].max() == middle[:, -1].max() == 0
    assert found[0, 40:88].max() == found[-1, 40:88].max() == 0


def test_the_cameras_differ_by_twenty_rows() -> None:
    image = np.random.default_rng(0).integers(0, 256, (600, 960, 3), dtype=np.uint8)
    moved = np.roll(image, 20, axis=0)
    for window in PLACES:
        left = cut(Image.fromarray(image), View("fl", window), 64)
        np.testing.assert_array_equal(left, cut(Image.fromarray(moved), View("fr", window), 64))


@pytest.mark.parametrize(("window", "side"), [("full", 128), ("c4", 128), ("c0", 64)])
def test_resizing_is_the_antialiased_bilinear_filter(window: str, side: int) -> None:
    """Equal to Pillow on a published slice of the array, and within one grey level of PyTorch's filter."""
    image = np.random.default_rng(1).integers(0, 256, (600, 960, 3), dtype=np.uint8)
    which, (left, right) = PLACES[window]
    top, low = ROWS["fr"][which]
    part = image[top : low + 1, left : right + 1]
    found = cut(Image.fromarray(image), View("fr", window), side)
    np.testing.assert_array_equal(
        found, np.asarray(Image.fromarray(part).resize((side, side), Image.Resampling.BILINEAR))
    )
    tensor = torch.from_numpy(part).permute(2, 0, 1)[None].float()
    smooth = torch.nn.functional.interpolate(tensor, (side, side), mode="bilinear", antialias=True)[0].permute(1, 2, 0)
    assert np.abs(found.astype(float) - smooth.numpy()).max() <= 1.0
