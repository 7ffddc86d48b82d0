"""Pictures inside the page: their kind, their size, their limit."""

from __future__ import annotations

import base64
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from apex_lab.report.pictures import MOVIE, STRIP, Budget


@pytest.fixture
def run(tmp_path: Path) -> Path:
    (tmp_path / "view").mkdir()
    iio.imwrite(tmp_path / STRIP, np.zeros((20, 50, 3), np.uint8))
    iio.imwrite(tmp_path / MOVIE, np.zeros((3, 32, 64, 3), np.uint8), fps=5, macro_block_size=16)
    return tmp_path


def test_pictures_carry_their_content_and_size(run: Path) -> None:
    budget = Budget(10**6)
    strip, movie = budget.strip(run), budget.movie(run)
    assert strip is not None
    assert movie is not None
    assert (strip.width, strip.height) == (50, 20)
    assert (movie.width, movie.height) == (64, 32)
    kind, _, data = movie.data.partition(",")
    assert kind == "data:video/mp4;base64"
    assert base64.b64decode(data) == (run / MOVIE).read_bytes()
    assert 10**6 - budget.left == sum(len(one.data.partition(",")[2]) for one in (strip, movie))
    assert budget.left_out == {}


def test_what_finds_no_room_is_named(run: Path) -> None:
    budget = Budget(100)
    assert budget.strip(run) is None
    assert budget.left_out == {run / STRIP: "no room"}
    assert budget.left == 100


def test_what_is_no_picture_is_named_and_not_embedded(run: Path) -> None:
    (run / STRIP).write_text("<svg onload='alert(1)'>")
    (run / MOVIE).write_bytes(b"")
    budget = Budget(10**6)
    assert budget.strip(run) is None
    assert budget.movie(run) is None
    assert budget.left_out == {run / STRIP: "is no PNG file", run / MOVIE: "is no MP4 file"}


def test_a_damaged_movie_has_no_size(run: Path) -> None:
    content = (run / MOVIE).read_bytes()
    (run / MOVIE).write_bytes(content[:40])
    movie = Budget(10**6).movie(run)
    assert movie is not None
    assert movie.width is None


def test_a_run_without_pictures_leaves_nothing_out(tmp_path: Path) -> None:
    budget = Budget(10)
    assert budget.strip(tmp_path) is None
    assert budget.left_out == {}
