"""Film strips read back pixel by pixel."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from apex_lab.scene import ABSENT
from apex_lab.view import Item, film_strip
from apex_lab.view.canvas import GAP, MARGIN, PAPER, enlarge
from apex_lab.view.colors import BACKGROUND_COLOR, NOTHING_COLOR, color_of
from apex_lab.view.film import _CAPTION, _LABELS, _TIMES, spread
from tests.view.scenes import BLUE, FIRST, GREY, RED, SECOND, H, T, W, item, scene, squares

SCALE = 6  # the smallest whole number that makes 24 pixels at least 128
ROWS = ("input", "reconstruction", "masks", "masks on input", "ground truth")


def read(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path))


def cell(page: np.ndarray, row: int, column: int) -> np.ndarray:
    """(H, W, 3): the middle pixel of every magnified pixel of a frame."""
    top = MARGIN + _CAPTION + _TIMES + row * (SCALE * H + GAP) + SCALE // 2
    left = MARGIN + _LABELS + column * (SCALE * W + GAP) + SCALE // 2
    return page[top : top + SCALE * H : SCALE, left : left + SCALE * W : SCALE]


def test_rows_show_input_reconstruction_masks_and_truth(tmp_path: Path) -> None:
    film_strip(tmp_path / "strip.png", [item()])
    page = read(tmp_path / "strip.png")
    assert page.shape == (
        2 * MARGIN + _CAPTION + _TIMES + 5 * (SCALE * H + GAP) - GAP,
        2 * MARGIN + _LABELS + T * (SCALE * W + GAP) - GAP,
        3,
    )
    video, labels, _ = squares()
    frames, truth = video[0].permute(0, 2, 3, 1).numpy(), labels[0].numpy()
    for t in range(T):
        np.testing.assert_array_equal(cell(page, 0, t), frames[t])
        np.testing.assert_array_equal(cell(page, 1, t), frames[t])
        for row, colors in ((2, (FIRST, SECOND)), (4, (1, 2))):
            shown = cell(page, row, t)
            assert (shown[truth[t] == 0] == BACKGROUND_COLOR).all()
            for label, identity in zip((1, 2), colors, strict=True):
                assert (shown[truth[t] == label] == color_of(identity)).all()
        laid = cell(page, 3, t)
        assert (laid[truth[t] == 0] == GREY).all()
        inside = laid[4, 4 + t].astype(int)
        np.testing.assert_allclose(inside, 0.45 * np.array(color_of(FIRST)) + 0.55 * np.array(RED), atol=0.5)


def test_equal_input_makes_equal_bytes_whatever_its_type(tmp_path: Path) -> None:
    name, video, said, b, truth = item()
    film_strip(tmp_path / "bytes.png", [Item(name, video, said, b, truth)])
    film_strip(tmp_path / "floats.png", [Item(name, video / 255, said, b, truth.to(torch.uint8))])
    wanted = (tmp_path / "bytes.png").read_bytes()
    assert (tmp_path / "floats.png").read_bytes() == wanted


def test_videos_stand_below_each_other(tmp_path: Path) -> None:
    film_strip(tmp_path / "one.png", [item("a")])
    film_strip(tmp_path / "two.png", [item("a"), item("a", truth=False)])
    one, two = read(tmp_path / "one.png"), read(tmp_path / "two.png")
    np.testing.assert_array_equal(two[: len(one)], one)
    assert len(two) == 2 * len(one) - (SCALE * H + GAP), "without ground truth there is no row for it"


def test_the_right_video_of_a_batch_is_drawn(tmp_path: Path) -> None:
    name, video, said, _, truth = item()
    other = dataclasses.replace(
        said,
        **{
            f: torch.cat([torch.zeros_like(v), v])
            for f in ("masks", "ids", "presence", "reconstruction")
            if (v := getattr(said, f)) is not None
        },
        appearance=said.appearance.repeat(2, 1, 1, 1),
        windows=None,
        means=None,
        terms={},
    )
    film_strip(tmp_path / "alone.png", [item()])
    pair = Item(name, torch.cat([255 - video, video]), other, 1, torch.cat([0 * truth, truth]))
    film_strip(tmp_path / "second.png", [pair])
    assert (tmp_path / "second.png").read_bytes() == (tmp_path / "alone.png").read_bytes()


def test_long_videos_are_thinned_out_evenly() -> None:
    assert spread(20, 8) == [0, 3, 5, 8, 11, 14, 16, 19]
    assert spread(5, 8) == [0, 1, 2, 3, 4]
    assert spread(1, 8) == [0]
    assert spread(20, 1) == [0]


def test_one_frame_without_any_object(tmp_path: Path) -> None:
    said = scene()
    nothing = dataclasses.replace(
        said, ids=torch.full_like(said.ids, ABSENT), masks=0 * said.masks, presence=0 * said.presence
    )
    first = {f: getattr(nothing, f)[:, :1] for f in ("masks", "ids", "presence", "appearance", "reconstruction")}
    video = squares()[0][:, :1]
    film_strip(
        tmp_path / "strip.png", [Item("", video, dataclasses.replace(nothing, **first, windows=None, means=None), 0)]
    )
    page = read(tmp_path / "strip.png")
    assert (cell(page, 2, 0) == NOTHING_COLOR).all()
    np.testing.assert_array_equal(cell(page, 3, 0), video[0, 0].permute(1, 2, 0).numpy())


def test_a_coarser_model_is_shown_at_the_size_of_the_video(tmp_path: Path) -> None:
    name, video, said, b, truth = item()
    half = dataclasses.replace(
        said, masks=said.masks[..., ::2, ::2], reconstruction=said.reconstruction[..., ::2, ::2], means=None
    )
    film_strip(tmp_path / "strip.png", [Item(name, video, half, b, truth)])
    page = read(tmp_path / "strip.png")
    np.testing.assert_array_equal(cell(page, 1, 0)[::2, ::2], cell(page, 0, 0)[::2, ::2])
    assert (cell(page, 2, 0)[2:8, 2:8] == color_of(FIRST)).all()
    assert (cell(page, 1, 2)[9, 15] == GREY).all() or (cell(page, 1, 2)[9, 15] == BLUE).all()


def test_enlarge_is_nearest_neighbour_like_pillow() -> None:
    picture = np.random.default_rng(0).integers(0, 255, (7, 5, 3), dtype=np.uint8)
    for size in ((7, 5), (21, 15), (14, 25), (3, 2)):
        wanted = Image.fromarray(picture).resize(size[::-1], Image.Resampling.NEAREST)
        np.testing.assert_array_equal(enlarge(picture, size), np.asarray(wanted))


def test_long_captions_are_cut(tmp_path: Path) -> None:
    film_strip(tmp_path / "strip.png", [item("video " * 100)])
    page = read(tmp_path / "strip.png")
    assert (page[:, -MARGIN:] == PAPER).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"video": torch.zeros(T, 3, H, W)}, r"video has the shape \(4, 3, 16, 24\), expected \(B, T, 3, H, W\)"),
        ({"video": torch.zeros(1, T, 3, H, W, dtype=torch.int64)}, "video is torch.int64, expected uint8 or floats"),
        ({"b": 1}, "b is 1, expected 0 to 0"),
        ({"video": torch.zeros(1, T + 1, 3, H, W)}, r"scene is of \(B, T\) = \(1, 4\), the video of \(1, 5\)"),
        ({"segmentation": torch.zeros(1, T, H, H)}, r"segmentation has the shape \(1, 4, 16, 16\)"),
    ],
)
def test_parts_that_do_not_fit_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        film_strip(tmp_path / "strip.png", [item()._replace(**change)])
    assert not list(tmp_path.iterdir())


def test_no_video_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="items is empty"):
        film_strip(tmp_path / "strip.png", [])
