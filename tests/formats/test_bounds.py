"""What files of strangers declare: refused before memory is taken, in one sentence."""

from __future__ import annotations

import json
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from apex_lab.base.errors import UserError
from apex_lab.formats import bounds, score_predictions
from apex_lab.formats.rle import decode
from apex_lab.formats.truth import load_json, open_truth


def npz(path: Path, masks: tuple[int, ...], declared: int | None = None) -> Path:
    """An npz file whose header declares a shape; its directory `declared` bytes more than there are."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, shape, kind in (("a__masks", masks, "|u1"), ("a__ids", masks[:2], "<i8")):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array_header_1_0(file, {"descr": kind, "fortran_order": False, "shape": shape})
                size = int(np.prod(shape)) * np.dtype(kind).itemsize
                for start in range(0, size if declared is None else 0, 2**20):
                    file.write(bytes(min(2**20, size - start)))
        if declared is not None:
            for part in archive.infolist():
                if "masks" in part.filename:
                    part.file_size = declared + 128
    return path


def test_an_npz_file_that_would_inflate_is_refused_by_its_header(tmp_path: Path) -> None:
    truth = tmp_path / "t.npz"
    np.savez(truth, a__gt=np.zeros((2, 8, 8), np.uint8))
    found = npz(tmp_path / "p.npz", (2, 3, 1000, 1000))
    assert found.stat().st_size < 100_000
    tracemalloc.start()
    with pytest.raises(UserError, match=r"masks: an array of 2 x 3 x 1000 x 1000 needs 0\.02 GB"):
        score_predictions(found, truth=truth, max_gigabytes=0.01)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5_000_000


def test_fifteen_tebibytes_in_header_and_directory(tmp_path: Path) -> None:
    truth = tmp_path / "t.npz"
    np.savez(truth, a__gt=np.zeros((2, 8, 8), np.uint8))
    shape = (2, 2, 2**21, 2**21)
    found = npz(tmp_path / "p.npz", shape, declared=int(np.prod(shape)))
    with pytest.raises(UserError, match=r"raise max_gigabytes|is no readable npz file"):
        score_predictions(found, truth=truth)


MASK = {"size": [2, 2], "counts": [4]}
BAD_MASKS: dict[str, tuple[Any, str]] = {
    "size of text": ({"size": ["16", "16"], "counts": [4]}, "its size is .*, and two whole numbers are wanted"),
    "size of truth values": ({"size": [True, True], "counts": [4]}, "two whole numbers are wanted"),
    "runs that come round": ({"size": [2, 2], "counts": [2**62, 2**62, 2**62, 2**62 + 4]}, "do not fill its 2 x 2"),
    "runs of 70 bits": ({"size": [2, 2], "counts": [2**70]}, "no run-length encoding"),
    "a number without end": ({"size": [2, 2], "counts": "P" * 100_000 + "0"}, "more than 64 bits"),
    "many empty runs": ({"size": [2, 2], "counts": [0] * 1000 + [4]}, "do not fill its 2 x 2"),
    "a start of 70 bits": (f"{2**70} 1", "no list of starts and lengths"),
}


@pytest.mark.parametrize("case", BAD_MASKS)
def test_masks_that_are_none(case: str) -> None:
    mask, told = BAD_MASKS[case]
    with pytest.raises(UserError, match=told):
        decode(mask, (2, 2), "p.json, result 0")


def coco_truth(path: Path, **image: Any) -> Path:
    page = {
        "videos": [{"id": 0, "name": "a"}],
        "images": [{"id": 0, "video_id": 0, "frame_id": 0, "width": 2, "height": 2, **image}],
        "annotations": [{"image_id": 0, "track_id": 1, "segmentation": MASK}],
    }
    path.write_text(json.dumps(page))
    return path


@pytest.mark.parametrize(
    ("image", "told"),
    [
        ({"width": 10**6, "height": 10**6}, "needs 8,000.00 GB, and max_gigabytes=1 is allowed: raise max_gigabytes"),
        ({"width": "2"}, "is no size; want whole numbers"),
        ({"frame_id": 10**30}, "a frame_id is of 100 bits; want a whole number of 64 bits at most"),
        ({"frame_id": float("inf")}, "ground truth in COCO's layout needs"),
    ],
)
def test_sizes_of_ground_truth(image: dict[str, Any], told: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=told):
        open_truth(coco_truth(tmp_path / "t.json", **image)).labels("a")


def test_ids_of_a_hundred_bits(tmp_path: Path) -> None:
    truth, found = coco_truth(tmp_path / "t.json"), tmp_path / "p.json"
    found.write_text(json.dumps([{"image_id": 0, "track_id": 10**30, "segmentation": MASK}]))
    with pytest.raises(UserError, match="result 0: track_id is of 100 bits"):
        score_predictions(found, truth=truth)
    found.write_text(json.dumps([[{"masks": [MASK], "ids": [10**30]}]]))
    with pytest.raises(UserError, match="video 0, frame 0: an id is of 100 bits"):
        score_predictions(found, truth=truth)
    lines = tmp_path / "mots"
    lines.mkdir()
    (lines / "a.txt").write_text(f"1 {2**70} 1 2 2 04\n")
    with pytest.raises(UserError, match=r"a\.txt, line 1: the id is of 71 bits"):
        score_predictions(lines, truth=truth)


def test_videos_that_would_fill_the_memory(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("9000000000 1 1 2 2 04\n")
    with pytest.raises(UserError, match=r"an array of 9000000000 x 2 x 2 needs 288.00 GB"):
        open_truth(tmp_path).labels("a")
    pictures = tmp_path / "pictures"
    (pictures / "a").mkdir(parents=True)
    Image.new("L", (400, 300)).save(pictures / "a" / "0.png")
    with bounds.at_most(0.0005), pytest.raises(UserError, match=r"0\.png: an array of 1 x 300 x 400 needs 0.00 GB"):
        open_truth(pictures).labels("a")


def test_json_that_is_nested_or_long(tmp_path: Path) -> None:
    path = tmp_path / "p.json"
    path.write_text("[" * 200_000)
    with pytest.raises(UserError, match=r"is no readable JSON file \(RecursionError"):
        load_json(path)
    with bounds.at_most(1e-4), pytest.raises(UserError, match=r"needs 0\.00 GB, and max_gigabytes=0\.0001"):
        load_json(path)
