"""Exports read back, by other libraries, as exactly the stored arrays."""

from __future__ import annotations

import configparser
import errno
from pathlib import Path

import cv2
import motmetrics
import numpy as np
import pytest
from pycocotools.coco import COCO

from sims.errors import SimError
from sims.p2d import export as module
from sims.p2d.__main__ import main
from sims.p2d.export import export
from sims.p2d.store import read_manifest
from tests.fakes.p2d_tools import make, small


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("p2d")
    make(path, small(train=3, test=0, image_size=24))
    return path


@pytest.fixture(scope="module")
def coco(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("coco") / "out"
    export(root, out, "coco", ["train", "val", "test"], shown=False)
    return out


@pytest.fixture(scope="module")
def mot(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("mot") / "out"
    export(root, out, "mot", ["train", "val"], shown=False)
    return out


def arrays(root: Path, split: str) -> dict[str, np.ndarray]:
    return {path.stem: np.load(path) for path in (root / split).glob("*.npy")}


def test_coco_masks_are_the_segmentation(root: Path, coco: Path):
    for split in ("train", "val"):
        stored = arrays(root, split)
        page = COCO(coco / "annotations" / f"instances_{split}.json")
        assert len(page.imgs) == stored["rgb"].shape[0] * 3
        for image in page.loadImgs(page.getImgIds()):
            video, frame = image["video_id"], image["frame_id"]
            picture = cv2.imread(str(coco / image["file_name"]))
            np.testing.assert_array_equal(picture[..., ::-1], stored["rgb"][video, frame])
            found = np.zeros((24, 24), np.uint8)
            for annotation in page.loadAnns(page.getAnnIds(image["id"])):
                mask = page.annToMask(annotation).astype(bool)
                assert not found[mask].any()
                found[mask] = annotation["track_id"]
                assert annotation["area"] == mask.sum()
                rows, columns = np.nonzero(mask)
                box = [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]
                assert annotation["bbox"] == [float(value) for value in box]
            np.testing.assert_array_equal(found, stored["segmentation"][video, frame])


def test_coco_categories_are_the_classes(root: Path, coco: Path):
    stored = arrays(root, "train")
    classes = read_manifest(root).facts["classes"]
    page = COCO(coco / "annotations" / "instances_train.json")
    for annotation in page.anns.values():
        name = page.cats[annotation["category_id"]]["name"]
        slot = annotation["track_id"] - 2
        assert name == ("arm" if slot < 0 else classes[stored["classes"][annotation["video_id"], slot]])
        part = slot + 1
        frame = page.imgs[annotation["image_id"]]["frame_id"]
        visible, amodal = (stored[key][annotation["video_id"], frame, part] for key in ("visible_px", "amodal_px"))
        assert annotation["visibility"] == pytest.approx(visible / amodal, abs=1e-4)


def test_coco_of_an_empty_split_is_empty(coco: Path):
    assert COCO(coco / "annotations" / "instances_test.json").imgs == {}


def test_mot_boxes_are_those_of_the_masks(root: Path, mot: Path):
    for split in ("train", "val"):
        stored = arrays(root, split)
        names = (mot / "seqmaps" / f"P2D-{split}.txt").read_text().split()
        assert names == ["name", *(f"{split}_{index:05d}" for index in range(len(stored["rgb"])))]
        for index, name in enumerate(names[1:]):
            folder = mot / f"P2D-{split}" / name
            table = motmetrics.io.loadtxt(folder / "gt" / "gt.txt", fmt="mot16", min_confidence=1)
            seen = 0
            for frame in range(3):
                for identity in set(np.unique(stored["segmentation"][index, frame])) - {0}:
                    row = table.loc[(frame + 1, identity)]
                    rows, columns = np.nonzero(stored["segmentation"][index, frame] == identity)
                    # the reader converts positions from 1-based to 0-based
                    box = (columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1)
                    assert (row.X, row.Y, row.Width, row.Height) == box
                    seen += 1
            assert seen == len(table)


def test_mot_sequences_describe_themselves(root: Path, mot: Path):
    stored = arrays(root, "val")
    folder = mot / "P2D-val" / "val_00001"
    info = configparser.ConfigParser()
    info.read(folder / "seqinfo.ini")
    sequence = info["Sequence"]
    assert sequence["name"] == folder.name
    assert (sequence["imWidth"], sequence["imHeight"], sequence["seqLength"]) == ("24", "24", "3")
    pictures = sorted((folder / sequence["imDir"]).glob(f"*{sequence['imExt']}"))
    assert [path.name for path in pictures] == ["000001.png", "000002.png", "000003.png"]
    np.testing.assert_array_equal(cv2.imread(str(pictures[2]))[..., ::-1], stored["rgb"][1, 2])
    classes = read_manifest(root).facts["classes"]
    named = dict(line.split() for line in (folder / "gt" / "names.txt").read_text().splitlines())
    used = [classes[number] for number in stored["classes"][1] if number >= 0]
    assert named == {"1": "arm", **{str(2 + slot): name for slot, name in enumerate(used)}}


def test_the_command(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "out"
    command = ["export", str(root), "--format", "mot", "--out", str(out), "--split", "val"]
    assert main(command) == 0
    assert sorted(path.name for path in out.iterdir()) == ["P2D-val", "seqmaps"]
    assert main(command) == 1
    assert capsys.readouterr().err.splitlines()[-1] == f"{out} exists already: choose another folder"


def test_a_full_disk_leaves_no_partial_export(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    written: list[Path] = []

    def full(path: Path, rgb: np.ndarray) -> None:
        if len(written) == 4:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        written.append(path)

    monkeypatch.setattr(module, "_write_png", full)
    with pytest.raises(SimError, match="No space left on device"):
        export(root, tmp_path / "out", "coco", ["train"], shown=False)
    assert list(tmp_path.iterdir()) == []


def test_damaged_data_are_not_exported(root: Path, tmp_path: Path):
    with pytest.raises(SimError, match="no P2D data at"):
        export(tmp_path / "none", tmp_path / "out", "coco", ["train"], shown=False)
