"""The data card's numbers against slow counting, and its page as a whole."""

from __future__ import annotations

import errno
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sims.errors import SimError
from sims.p2d import draw
from sims.p2d.__main__ import main
from sims.p2d.card import write_card
from sims.p2d.stats import Stats, statistics
from sims.p2d.store import read_manifest
from tests.fakes.p2d_tools import make, small


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("p2d")
    make(path, small(train=12, frames=5, image_size=32))
    return path


@pytest.fixture(scope="module")
def stats(root: Path) -> Stats:
    return statistics(root, read_manifest(root))


def videos(root: Path, name: str) -> np.ndarray:
    return np.concatenate([np.load(root / split / f"{name}.npy") for split in ("train", "val", "test")])


def test_calibration_is_what_a_model_with_one_segment_scores(root: Path, stats: Stats):
    visible, msc, msc_fg = [], [], []
    for frame in videos(root, "segmentation").reshape(-1, 32 * 32):
        ids = np.unique(frame)
        areas = {identity: (frame == identity).mean() for identity in ids}
        objects = [area for identity, area in areas.items() if identity > 0]
        visible.append(len(objects))
        msc.append(np.mean(list(areas.values())))
        msc_fg.append(np.mean(objects) if objects else 0.0)
    assert stats.visible_per_frame == pytest.approx(np.mean(visible))
    assert stats.one_segment_msc == pytest.approx(np.mean(msc))
    assert stats.one_segment_msc_fg == pytest.approx(np.mean(msc_fg))


def test_contact_and_moves(root: Path, stats: Stats):
    poses, contact = videos(root, "poses"), videos(root, "arm_contact")
    for n in range(len(poses)):
        pushed = False
        for slot in range(3):
            if np.isnan(poses[n, 0, slot, 0]):
                assert np.isnan(stats.moved_m[n, slot])
                continue
            moved = max(np.linalg.norm(poses[n, t, slot, :3] - poses[n, 0, slot, :3]) for t in range(5))
            assert stats.moved_m[n, slot] == pytest.approx(moved, abs=1e-6)
            pushed |= bool(contact[n, :, slot].any() and moved >= 0.02)
        assert stats.pushed[n] == pushed
        assert stats.touched[n] == contact[n].any()


def test_occlusion_area_and_cut(root: Path, stats: Stats):
    segmentation, amodal = videos(root, "segmentation"), videos(root, "amodal_px")
    for n, t, part in np.ndindex(*stats.area.shape):
        mask = segmentation[n, t] == part + 1
        assert np.nan_to_num(stats.area[n, t, part]) == pytest.approx(mask.mean())
        border = mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any()
        assert stats.cut[n, t, part] == border
        if amodal[n, t, part]:
            assert stats.occlusion[n, t, part] == pytest.approx(1 - mask.sum() / amodal[n, t, part])


def test_page_has_every_part_and_no_gap(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["card", str(root), "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out == f"data card: {tmp_path / 'README.md'}\n"
    text = (tmp_path / "README.md").read_text()
    assert "nan%" not in text
    for name in re.findall(r"\]\(([^)]+)\)", text):
        with Image.open(tmp_path / name) as picture:
            assert min(picture.size) > 300
    for name in read_manifest(root).facts["classes"]:
        assert f"| {name} |" in text
    assert "| 0.28 |" in text
    assert "| 0.06 |" in text


def test_page_of_the_smallest_data_set(tmp_path: Path):
    make(tmp_path / "data", small(train=1, val=0, test=0, frames=1, max_objects=1))
    assert "nan" not in write_card(tmp_path / "data", tmp_path / "card").read_text().replace("banana", "")


def test_page_of_nothing_is_refused(tmp_path: Path):
    make(tmp_path, small(train=0, val=0, test=0))
    with pytest.raises(SimError, match="holds no trajectory"):
        write_card(tmp_path, tmp_path / "card")


def test_a_full_disk_is_named_and_leaves_no_page(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(draw, "histograms", full)
    with pytest.raises(SimError, match="free space on that disk"):
        write_card(root, tmp_path / "card")
    assert not (tmp_path / "card" / "README.md").exists()


def test_overlay_outlines_every_mask_in_its_colour():
    segmentation = np.zeros((8, 8), np.uint8)
    segmentation[2:6, 2:6] = 3
    picture = draw.overlay(np.full((8, 8, 3), 100, np.uint8), segmentation)
    edge = (segmentation == 3) & ~np.pad(np.ones((2, 2), bool), 3)
    np.testing.assert_array_equal(picture[edge], np.broadcast_to(draw.colour_of(np.array(3)), (12, 3)))
    assert len(np.unique(picture[0, :, 0])) == 1
