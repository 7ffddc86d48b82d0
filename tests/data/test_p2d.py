"""The plain torch data set: items equal to the arrays, in any process, and clear words about folders it cannot read."""

from __future__ import annotations

import errno
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from apex_lab.base.errors import UserError
from apex_lab.data import P2D
from apex_lab.data.bench_loading import frames_per_second
from recordings import MANIFEST
from tests.fakes.p2d_fake import simulate
from tests.fakes.p2d_tools import REPOSITORY, make, small

SETTINGS = small(train=6, frames=5)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("p2d")
    make(path, SETTINGS)
    return path


def test_items_are_the_simulated_videos(root: Path):
    data = P2D(root, "train")
    assert len(data) == 6
    for index in range(6):
        expected = simulate(SETTINGS, "train", index)
        item = data[index]
        assert sorted(item) == ["index", "name", "segmentation", "video"]
        assert (item["index"], item["name"]) == (index, f"train_{index:05d}")
        assert item["video"].shape == (5, 3, 16, 16)
        assert item["video"].dtype == item["segmentation"].dtype == torch.uint8
        assert item["video"].is_contiguous()
        np.testing.assert_array_equal(item["video"].permute(0, 2, 3, 1), expected.rgb)
        np.testing.assert_array_equal(item["segmentation"], expected.segmentation)


def test_items_belong_to_the_caller(root: Path):
    data = P2D(root, "train")
    item = data[0]
    item["video"].zero_()
    item["segmentation"].zero_()
    assert data[0]["video"].any()
    assert data[0]["segmentation"].any()


def test_a_part_of_the_frames(root: Path):
    whole, part = P2D(root, "val")[1], P2D(root, "val", frames=2, start=3)[1]
    torch.testing.assert_close(part["video"], whole["video"][3:5])
    torch.testing.assert_close(part["segmentation"], whole["segmentation"][3:5])
    np.testing.assert_array_equal(P2D(root, "val", 2, 3).meta(1)["depth"], P2D(root, "val").meta(1)["depth"][3:5])
    assert P2D(root, "val", frames=2).meta(1)["classes"].shape == (3,)


@pytest.mark.parametrize(("frames", "start"), [(6, 0), (2, 4), (0, 0), (1, -1), (None, 5)])
def test_frames_that_are_not_there_are_refused(root: Path, frames: int | None, start: int):
    with pytest.raises(UserError, match="cannot be read: it has 0 to 4"):
        P2D(root, "val", frames, start)


def test_meta_holds_everything_else(root: Path):
    data = P2D(root, "test")
    expected = simulate(SETTINGS, "test", 1)
    meta = data.meta(1)
    for name in meta.keys() - {"names"}:
        np.testing.assert_array_equal(meta[name], getattr(expected, name))
    assert {"depth", "poses", "visible_px", "amodal_px", "arm_contact", "object_contact"} <= set(meta)
    assert meta["names"] == [SETTINGS.objects[number] for number in expected.classes if number >= 0]
    assert np.shape(data.camera["intrinsics"]) == (3, 3)


def test_positions_count_from_both_ends_and_stop(root: Path):
    data = P2D(root, "train")
    assert data[-1]["index"] == 5
    for index in (6, -7):
        with pytest.raises(IndexError, match="has 6"):
            data[index]
        with pytest.raises(IndexError):
            data.meta(index)


def test_loading_processes_and_pickles_see_the_same(root: Path):
    data = P2D(root, "train")
    here = torch.stack([data[index]["video"] for index in range(6)])
    there = torch.cat([batch["video"] for batch in DataLoader(data, batch_size=4, num_workers=2)])
    torch.testing.assert_close(there, here)
    text = pickle.dumps(data)
    assert len(text) < 20_000
    torch.testing.assert_close(pickle.loads(text)[2]["video"], here[2])


def test_median_is_that_of_all_pixels(root: Path):
    expected = np.median(np.load(root / "train" / "rgb.npy").reshape(-1, 16, 16, 3), axis=0).transpose(2, 0, 1) / 255
    for _ in range(2):  # computed, then from the folder
        median = P2D(root, "train").median(sample=None)
        assert median.dtype == torch.float32
        np.testing.assert_allclose(median, expected, atol=1e-7)
    sampled = P2D(root, "train").median(sample=7)
    frames = np.load(root / "train" / "rgb.npy").reshape(-1, 16, 16, 3)[[0, 4, 8, 12, 17, 21, 25]]
    np.testing.assert_allclose(sampled, np.median(frames, axis=0).transpose(2, 0, 1) / 255, atol=1e-7)


def test_median_of_a_folder_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    make(tmp_path, SETTINGS)

    def read_only(*_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(os, "replace", read_only)
    first, second = P2D(tmp_path, "val").median(), P2D(tmp_path, "val").median()
    assert first.shape == (3, 16, 16)
    torch.testing.assert_close(first, second)


@pytest.mark.parametrize("size", [0, 60, 500])
def test_a_median_that_was_cut_off_is_computed_anew(tmp_path: Path, size: int):
    make(tmp_path, SETTINGS)
    median = P2D(tmp_path, "val").median()
    os.truncate(next(tmp_path.glob(".median_val_*.npy")), size)
    torch.testing.assert_close(P2D(tmp_path, "val").median(), median)


def test_an_empty_split_has_no_median(tmp_path: Path):
    make(tmp_path, small(val=0))
    data = P2D(tmp_path, "val")
    assert len(data) == 0
    with pytest.raises(UserError, match="is empty"):
        data.median()


def test_folders_that_cannot_be_read_are_refused_in_one_sentence(root: Path, tmp_path: Path):
    with pytest.raises(UserError, match="no split 'valid': choose one of train, val, test"):
        P2D(root, "valid")
    with pytest.raises(UserError, match=r"no P2D data at .*: make them with python -m sims.p2d --out"):
        P2D(tmp_path / "none", "train")
    make(tmp_path, SETTINGS)
    os.truncate(tmp_path / "train" / "rgb.npy", 1000)
    with pytest.raises(UserError, match=r"rgb.npy is truncated .*: repair it with python -m sims.p2d verify"):
        P2D(tmp_path, "train")
    assert len(P2D(tmp_path, "val")) == 2  # the other splits are as good as before
    (tmp_path / MANIFEST).unlink()
    with pytest.raises(UserError, match=r"is not finished \(10 of 10 trajectories made\): resume with python -m sims"):
        P2D(tmp_path, "val")


def test_using_it_imports_no_lightning_no_hydra_no_simulator(root: Path):
    code = f"""
import sys
from apex_lab.data import P2D
P2D({str(root)!r}, "train")[0]
print([name for name in ("lightning", "hydra", "omegaconf", "pybullet", "trimesh") if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_speed_can_be_measured(root: Path):
    assert frames_per_second(P2D(root, "train"), batch_size=2, workers=0, seconds=0.05) > 1000
