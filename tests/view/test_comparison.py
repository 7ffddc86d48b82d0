"""Models side by side: equal colours for matching objects, and where everything lies on the page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from apex_lab.view.canvas import GAP
from apex_lab.view.colors import BACKGROUND_COLOR, color_of
from apex_lab.view.comparison import BACKGROUND, NOTHING, Shown, colours, comparison

T, H, W = 2, 32, 32


def labels(*squares: tuple[int, int, int], background: int = 0) -> np.ndarray:
    """Squares of 8 pixels with (identity, top, left) on a background."""
    found = np.full((T, H, W), background, dtype=np.int64)
    for identity, top, left in squares:
        found[:, top : top + 8, left : left + 8] = identity
    return found


def shown(name: str, segmentation: np.ndarray, background: int | None = 0) -> Shown:
    is_background = np.zeros(segmentation.shape, dtype=bool) if background is None else segmentation == background
    return Shown(name, segmentation, is_background, np.full((T, H, W, 3), 77, dtype=np.uint8))


def test_objects_that_match_the_truth_have_its_colours_and_others_free_ones() -> None:
    truth = labels((1, 0, 0), (2, 16, 16))
    one = shown("one", labels((7, 16, 16), (5, 1, 1), (9, 0, 20)))
    two = shown("two", labels((1, 16, 17), (2, 0, 0)))
    found = colours([one, two], truth)
    assert found[0][0, 20, 20] == 2
    assert found[0][0, 4, 4] == 1
    assert found[0][0, 4, 24] not in (1, 2)
    assert found[0][0, 31, 0] == BACKGROUND
    assert found[1][0, 20, 20] == 2
    assert found[1][0, 4, 4] == 1


def test_without_truth_the_first_model_gives_the_colours() -> None:
    one, two = shown("one", labels((7, 16, 16), (5, 0, 0))), shown("two", labels((1, 16, 16), (2, 0, 0)))
    found = colours([one, two])
    assert np.array_equal(found[0], found[1])
    nothing = shown("three", labels(background=-1), None)
    assert (colours([one, nothing])[1] == NOTHING).all()


def test_rows_of_the_page(tmp_path: Path) -> None:
    truth = labels((1, 0, 0))
    frames = np.full((T, H, W, 3), 200, dtype=np.uint8)
    comparison(tmp_path / "a" / "clip.png", "clip", frames, [shown("one", labels((4, 0, 0)))], truth)
    page = np.asarray(Image.open(tmp_path / "a" / "clip.png"))
    column = page[:, page.shape[1] - 12 - 1 - 120]  # inside the last frame's left edge, where the square is
    row = 12 + 30 + 22
    cell = 128
    found = [column[row + 8].tolist()]
    for gap in (GAP + 10, GAP + 10, GAP):
        row += cell + gap
        found.append(column[row + 8].tolist())
    assert found == [[200] * 3, list(color_of(1)), list(color_of(1)), [77] * 3]
    assert column[row - GAP - 8].tolist() == list(BACKGROUND_COLOR)
    assert page.shape[0] == row + cell + 12


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    frames = np.zeros((T, H, W, 3), dtype=np.uint8)
    with pytest.raises(ValueError, match="models is empty"):
        comparison(tmp_path / "x.png", "clip", frames, [])
    with pytest.raises(ValueError, match=r"one has the size \(2, 32, 32\), the clip \(1, 32, 32\)"):
        comparison(tmp_path / "x.png", "clip", frames[:1], [shown("one", labels())])
