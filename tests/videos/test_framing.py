"""Crop and letterbox, and what of the frame they show."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apex_lab.videos import framing
from apex_lab.videos.framing import Rectangle

SIDES = st.integers(1, 300)


def test_crop_takes_the_middle_and_letterbox_everything() -> None:
    crop = framing((48, 64), (32, 32), "crop")
    assert (crop.source, crop.target) == (Rectangle(0, 8, 48, 48), Rectangle(0, 0, 32, 32))
    box = framing((48, 64), (32, 32), "letterbox")
    assert (box.source, box.target) == (Rectangle(0, 0, 48, 64), Rectangle(4, 0, 24, 32))
    image = np.full((48, 64, 3), 200, dtype=np.uint8)
    image[:, :8] = 0
    assert (crop.fitted(image) == 200).all()
    found = box.fitted(image)
    assert (found[:4] == 0).all()
    assert (found[28:] == 0).all()
    assert (found[4:28, 4:] == 200).all()
    assert (found[4:28, :4] == 0).all()


def test_an_input_that_is_no_square() -> None:
    crop = framing((100, 100), (32, 64), "crop")
    assert crop.source == Rectangle(25, 0, 50, 100)
    assert framing((100, 100), (32, 64), "letterbox").target == Rectangle(0, 16, 32, 32)


def test_frames_of_the_input_s_size_are_not_touched() -> None:
    image = np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    for fit in ("crop", "letterbox"):
        assert np.array_equal(framing((32, 32), (32, 32), fit).fitted(image), image)


def test_shrinking_averages() -> None:
    image = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    wanted = image.reshape(16, 4, 16, 4, 3).mean(axis=(1, 3))
    assert np.abs(framing((64, 64), (16, 16), "crop").fitted(image) - wanted).max() <= 0.51


@given(st.tuples(SIDES, SIDES), st.tuples(SIDES, SIDES), st.sampled_from(["crop", "letterbox"]))
def test_parts_lie_inside_and_keep_their_shape(frame: tuple[int, int], input: tuple[int, int], fit: str) -> None:
    found = framing(frame, input, fit)  # type: ignore[arg-type]
    for part, whole in ((found.source, frame), (found.target, input)):
        assert 0 <= part.top <= part.top + part.height <= whole[0]
        assert 0 <= part.left <= part.left + part.width <= whole[1]
        assert min(part.height, part.width) >= 1
        assert abs(2 * part.top + part.height - whole[0]) <= 1
        assert abs(2 * part.left + part.width - whole[1]) <= 1
    part, outer = (found.source, frame) if fit == "crop" else (found.target, input)
    assert part.height == outer[0] or part.width == outer[1]
    # equal proportions, up to the rounding of a side to whole pixels
    free = found.source if fit == "crop" else found.target
    other = input if fit == "crop" else frame
    exact = min(outer[0] / other[0], outer[1] / other[1])
    assert free.height == pytest.approx(other[0] * exact, abs=1)
    assert free.width == pytest.approx(other[1] * exact, abs=1)
