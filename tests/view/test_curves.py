"""Curve pages: what stands where, and tables as they really are: holes, repeats, damage."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from apex_lab.base.errors import UserError
from apex_lab.view import curve_page
from apex_lab.view.curves import _panels, read_curves

ROWS = (
    {"step": 1, "epoch": 0, "train/loss": 100, "train/nll": 90, "train/gradient_norm": 5},
    {"step": 1, "diagnostics/live_objects": 3, "diagnostics/share_0": 0.7, "diagnostics/share_1": 0.3},
    {"step": 2, "epoch": 0, "train/loss": 80, "diagnostics/share_1": 0.2, "schedule/temperature": 1.0},
    {"step": 2, "val/loss": 85, "val/ari_fg": 0.25, "val/broken": "nan"},
    {"step": 3, "epoch": 0, "train/loss": 60, "train/nll": 50},
    {"step": 4, "epoch": 0, "train/loss": "inf", "train/nll": 40, "val/loss": 50, "val/ari_fg": 0.5},
    {"step": 3, "epoch": 1, "train/loss": 61, "train/nll": 51},
)


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "curves.csv"
    pd.DataFrame(ROWS).to_csv(path, index=False)
    return path


def test_panels_group_splits_and_numbers_in_reading_order(table: Path) -> None:
    panels = _panels(read_curves(table))
    assert list(panels) == ["loss", "ari_fg", "nll", "gradient_norm", "live_objects", "share", "temperature"]
    assert [label for label, _, _ in panels["loss"]] == ["train", "val"]
    assert [label for label, _, _ in panels["share"]] == ["0", "1"]
    (_, train_color, train), (_, val_color, val) = panels["loss"]
    assert train_color != val_color
    assert val.to_dict() == {2: 85.0, 4: 50.0}
    assert train.to_dict() == {1: 100.0, 2: 80.0, 3: 61.0}, (
        "a step made twice counts as it was made last; inf is a hole"
    )


def test_a_single_numbered_column_keeps_its_name(tmp_path: Path) -> None:
    (tmp_path / "curves.csv").write_text("step,train/kl_2,test/ari\n1,3.0,0.5\n")
    assert set(_panels(read_curves(tmp_path / "curves.csv"))) == {"kl_2", "ari"}


def test_page_is_a_picture_with_as_many_rows_as_needed(table: Path, tmp_path: Path) -> None:
    curve_page(tmp_path / "curves.png", table)
    page = Image.open(tmp_path / "curves.png")
    assert page.size == (1440, 560)
    dark = (np.asarray(page.convert("L")) < 128).mean()
    assert 0.003 < dark < 0.2


def test_equal_curves_make_equal_bytes_whatever_the_users_style(table: Path, tmp_path: Path) -> None:
    curve_page(tmp_path / "a.png", table)
    with mpl.rc_context({"axes.facecolor": "black", "lines.linewidth": 9, "font.size": 30}):
        curve_page(tmp_path / "b.png", table)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_long_noisy_curves_and_single_points(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    rows = [f"{i},{np.exp(rng.normal() * 3)},{-i}" for i in range(1, 1001)]
    (tmp_path / "curves.csv").write_text("\n".join(["step,train/gradient_norm,train/nll", *rows]))
    curve_page(tmp_path / "long.png", tmp_path / "curves.csv")
    (tmp_path / "curves.csv").write_text("step,train/loss\n1,3.5\n")
    curve_page(tmp_path / "point.png", tmp_path / "curves.csv")
    assert Image.open(tmp_path / "long.png").size == Image.open(tmp_path / "point.png").size


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "does not exist: train the run first"),
        ("", "cannot be read"),
        ("loss\n1.0\n", "has no column 'step'"),
        ("step,epoch,train/loss\n", "holds no numbers yet"),
        ("step,epoch,train/loss\n1,0,\n2,0,nan\n", "holds no numbers yet"),
        ('step,loss\n1,2\n1,2,3,4\n"', "cannot be read"),
        (b"\xff\xfe\x00step", "cannot be read"),
    ],
)
def test_useless_tables_are_named(tmp_path: Path, content: str | bytes | None, message: str) -> None:
    path = tmp_path / "curves.csv"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(UserError, match=message) as caught:
        curve_page(tmp_path / "curves.png", path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "curves.png").exists()
