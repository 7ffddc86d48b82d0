"""Panels per component read back, and the numbers behind them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from apex_lab.scene import ABSENT, Scene
from apex_lab.view import Item, component_panels
from apex_lab.view.canvas import GAP, MARGIN, PAPER
from apex_lab.view.colors import color_of
from apex_lab.view.panels import (
    _BACKGROUND_TONE,
    _CAPTION,
    _GROUP_GAP,
    _HEADING,
    _LABELS,
    _PLOT,
    _SCALE,
    _TIME,
    lives,
)
from tests.view.scenes import BACKGROUND, BLUE, FIRST, GREY, RED, SECOND, H, T, W, item, scene, squares

SCALE = 4  # 24 pixels to at least 96


def panel(page: np.ndarray, row: int, stage: int, column: int, columns: int = 3) -> np.ndarray:
    """(H, W, 3): the first pixel right and below the middle of every magnified pixel of a panel."""
    group = columns * (SCALE * W + GAP) + _GROUP_GAP
    top = MARGIN + _CAPTION + _HEADING + row * (_TIME + SCALE * H + 2 * GAP) + _TIME + SCALE // 2
    left = MARGIN + _LABELS + stage * group + column * (SCALE * W + GAP) + SCALE // 2
    return page[top : top + SCALE * H : SCALE, left : left + SCALE * W : SCALE]


def draw(path: Path, **parts: bool) -> np.ndarray:
    component_panels(path, item(**parts))
    return np.asarray(Image.open(path))


def test_lives_tell_share_presence_and_frames() -> None:
    background, first, second = lives(scene())
    assert [background.identity, first.identity, second.identity] == [BACKGROUND, FIRST, SECOND]
    assert [background.background, first.background, second.background] == [True, False, False]
    assert second.component.tolist() == [-1, 1, 1, 1]
    assert second.presence.tolist() == [0, 1, 1, 1]
    np.testing.assert_allclose(second.share, np.array([0, 36, 36, 36]) / (H * W))
    assert second.frames.tolist() == [1, 2, 3]


def test_an_identity_may_change_its_component() -> None:
    swapped = scene()
    order = torch.tensor([1, 0, 2])
    for field in ("masks", "ids", "presence"):
        getattr(swapped, field)[:, 2:] = getattr(swapped, field)[:, 2:][:, :, order]
    first = next(life for life in lives(swapped) if life.identity == FIRST)
    assert first.component.tolist() == [0, 0, 1, 1]
    np.testing.assert_allclose(first.share, 36 / (H * W))


def test_rows_show_mask_appearance_and_window(tmp_path: Path) -> None:
    page = draw(tmp_path / "panels.png")
    assert page.shape == (
        2 * MARGIN + _CAPTION + _HEADING + 3 * (_TIME + SCALE * H + 2 * GAP),
        2 * MARGIN + _LABELS + 3 * (3 * (SCALE * W + GAP) + _GROUP_GAP) + _PLOT,
        3,
    )
    masks = squares()[2][0]
    for row, (k, tone, color) in enumerate(
        ((2, _BACKGROUND_TONE, GREY), (0, color_of(FIRST), RED), (1, color_of(SECOND), BLUE))
    ):
        times = (0, 2, 3) if k != 1 else (1, 2, 3)
        for stage, t in enumerate(times):
            shown, mask = panel(page, row, stage, 0), masks[t, k].numpy() > 0
            assert (shown[mask] == tone).all()
            assert (shown[~mask] == 0).all()
            assert (panel(page, row, stage, 1) == color).all()


def test_windows_are_drawn_where_they_are(tmp_path: Path) -> None:
    page = draw(tmp_path / "panels.png")
    group = 3 * (SCALE * W + GAP) + _GROUP_GAP
    top = MARGIN + _CAPTION + _HEADING + 1 * (_TIME + SCALE * H + 2 * GAP) + _TIME
    left = MARGIN + _LABELS + 2 * group + 2 * (SCALE * W + GAP)  # last frame, t = 3: rows 2 to 8, columns 5 to 11
    view = page[top : top + SCALE * H, left : left + SCALE * W]
    is_line = (view == color_of(FIRST)).all(axis=-1)
    rows, columns = np.flatnonzero(is_line.any(axis=1)), np.flatnonzero(is_line.any(axis=0))
    assert abs(rows[0] - 2 * SCALE) <= 1
    assert abs(rows[-1] - 8 * SCALE) <= 1
    assert abs(columns[0] - 5 * SCALE) <= 1
    assert abs(columns[-1] - 11 * SCALE) <= 1
    assert not is_line[5 * SCALE, 8 * SCALE], "a window is an outline"
    background = panel(page, 0, 0, 2)
    assert background.max() < 215, "a component without a window shows a dimmed input"


def test_presence_is_a_bar_per_frame(tmp_path: Path) -> None:
    page = draw(tmp_path / "panels.png")
    left = MARGIN + _LABELS + 3 * (3 * (SCALE * W + GAP) + _GROUP_GAP)
    top = MARGIN + _CAPTION + _HEADING + 2 * (_TIME + SCALE * H + 2 * GAP) + _TIME
    middle = page[top + SCALE * H // 2, left : left + _PLOT]
    centres = [int(30 + (t + 0.5) * (_PLOT - 30 - _SCALE) / T) for t in range(T)]
    assert [tuple(middle[x].tolist()) for x in centres] == [PAPER, *3 * [color_of(SECOND)]]


def test_models_without_windows_or_pictures(tmp_path: Path) -> None:
    page = draw(tmp_path / "panels.png", windows=False, means=False)
    assert page.shape[1] == 2 * MARGIN + _LABELS + 3 * (2 * (SCALE * W + GAP) + _GROUP_GAP) + _PLOT
    mask = squares()[2][0, 0, 0].numpy() > 0
    shown = panel(page, 1, 0, 1, columns=2)
    assert (shown[mask] == RED).all()
    assert (shown[~mask] == 0).all()


def odd(said: Scene, kind: str) -> Scene:
    if kind == "nobody":
        return dataclasses.replace(said, ids=torch.full_like(said.ids, ABSENT), masks=0 * said.masks)
    if kind == "crowd":
        wide = {
            f: getattr(said, f).repeat(1, 1, 20, *[1] * (getattr(said, f).ndim - 3))
            for f in ("masks", "presence", "appearance", "windows", "means")
        }
        return dataclasses.replace(
            said, **wide, ids=torch.arange(60).repeat(1, T, 1), background=torch.zeros(60, dtype=torch.bool)
        )
    windows = torch.tensor(
        {"huge": [1e6, 1e6, 0.0, 0.0], "tiny": [0.0, 0.0, 0.0, 0.0], "far": [0.2, 0.2, 50.0, -50.0]}[kind]
    )
    return dataclasses.replace(said, windows=windows.expand(1, T, 3, 4))


@pytest.mark.parametrize(("kind", "rows"), [("nobody", 1), ("crowd", 10), ("huge", 3), ("tiny", 3), ("far", 3)])
def test_odd_scenes_are_drawn(tmp_path: Path, kind: str, rows: int) -> None:
    name, video, said, b, truth = item()
    component_panels(tmp_path / "panels.png", Item(name, video, odd(said, kind), b, truth))
    page = np.asarray(Image.open(tmp_path / "panels.png"))
    assert len(page) == 2 * MARGIN + _CAPTION + _HEADING + rows * (_TIME + SCALE * H + 2 * GAP)
    assert (page[:, -MARGIN:] == PAPER).all()


def test_long_videos_fit(tmp_path: Path) -> None:
    name, video, said, b, _ = item()
    many = 100
    long = {
        f: getattr(said, f).repeat(1, many, *[1] * (getattr(said, f).ndim - 2))
        for f in ("masks", "ids", "presence", "appearance", "reconstruction", "windows", "means")
    }
    component_panels(
        tmp_path / "panels.png", Item(name, video.repeat(1, many, 1, 1, 1), dataclasses.replace(said, **long), b)
    )
    page = np.asarray(Image.open(tmp_path / "panels.png"))
    assert (page[:, -MARGIN:] == PAPER).all()
