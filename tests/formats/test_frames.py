"""Frames and videos are found by number; label images of every depth are read."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from apex_lab.base.errors import UserError
from apex_lab.formats import NpzWriter, PredictedVideo, open_truth, open_writer, score_predictions
from apex_lab.formats.davis import palette, read_davis, video_names
from apex_lab.formats.mots import read_mots
from apex_lab.metrics.bench_scoring import synthetic_video


def pictures(folder: Path, labels: np.ndarray, name: str = "{}.png", start: int = 0) -> Path:
    folder.mkdir(parents=True)
    for t, frame in enumerate(labels):
        image = Image.fromarray(frame.astype(np.uint8), mode="P")
        image.putpalette(palette().tobytes())  # without one, Pillow writes a single bit
        image.save(folder / name.format(t + start), "png")
    return folder


@pytest.fixture
def truth(tmp_path: Path) -> np.ndarray:
    """Twelve frames, also in truth.npz."""
    _, labels = synthetic_video(1, 12, 32, 3, 6)
    with NpzWriter(tmp_path / "truth.npz") as writer:
        writer.add(PredictedVideo("v", labels, labels))
    return labels


PERFECT = {"ari_fg": 1, "mota": 100, "hota": 1, "jf": 1, "video_ari": 1}


@pytest.mark.parametrize("name", ["{}.png", "{:05d}.png", "frame{}.png", "seg_2_{:02d}.png", "{}_mask4.png", "{}.PNG"])
@pytest.mark.parametrize("start", [0, 1])
def test_frames_count_by_number(tmp_path: Path, truth: np.ndarray, name: str, start: int) -> None:
    pictures(tmp_path / "p" / "v", truth, name, start)
    (tmp_path / "p" / "v" / "._0.png").write_bytes(b"left by a Mac")
    total = score_predictions(tmp_path / "p", truth=tmp_path / "truth.npz")["total"]
    assert {key: total[key] for key in PERFECT} == PERFECT
    pictures(tmp_path / "t" / "v", truth, "{:04d}.png", start)
    total = score_predictions(tmp_path / "p", truth=tmp_path / "t")["total"]
    assert {key: total[key] for key in PERFECT} == PERFECT


def test_videos_count_by_number_too(tmp_path: Path, truth: np.ndarray) -> None:
    """The layout of Weis et al. has no names: the order of the ground truth's videos decides."""
    parts = [truth[i : i + 2] for i in range(0, 12)][:11]
    with open_writer("weis", tmp_path / "p.json") as weis, open_writer("mots", tmp_path / "mots") as mots:
        for i, part in enumerate(parts):
            weis.add(PredictedVideo(f"v{i}", part))
            mots.add(PredictedVideo(f"v{i}", part))
    for i, part in enumerate(parts):
        pictures(tmp_path / "t" / f"v{i}", part)
    assert video_names(tmp_path / "t") == [f"v{i}" for i in range(11)] == open_truth(tmp_path / "t").names
    assert score_predictions(tmp_path / "p.json", truth=tmp_path / "t")["total"]["hota"] == 1
    found = score_predictions(tmp_path / "mots", truth=tmp_path / "t")
    assert [row["video"] for row in found["per_video"]] == [f"v{i}" for i in range(11)]


@pytest.mark.parametrize(
    ("names", "told"),
    [
        (["0", "1", "3"], "the prediction has 3 frames from 0 to 3, the ground truth 3 frames from 0 to 2: frame 2 is"),
        (["1", "2", "3"], "frame 0 is in the ground truth alone; number the frames alike"),
        (["0", "1"], "frame 2 is in the ground truth alone"),
        (["0", "1", "2", "3"], "frame 3 is in the prediction alone"),
        (["0", "1", "01"], r"0?1.png and 0?1.png are both frame 1; remove one of them"),
        (["a", "b", "c"], "the name a.png holds no number of a frame"),
        (["a0", "b1", "c2"], "a0.png and b1.png differ in more than a number"),
        (["0_5", "1_6", "2_7"], "hold several numbers that differ"),
    ],
)
def test_frames_that_do_not_pair_are_refused(tmp_path: Path, truth: np.ndarray, names: list[str], told: str) -> None:
    pictures(tmp_path / "t" / "v", truth[:3])
    (tmp_path / "p" / "v").mkdir(parents=True)
    for name in names:
        Image.fromarray(truth[0].astype(np.uint8), mode="P").save(tmp_path / "p" / "v" / f"{name}.png")
    with pytest.raises(UserError, match=told) as caught:
        score_predictions(tmp_path / "p", truth=tmp_path / "t")
    assert "\n" not in str(caught.value)


def test_gaps_are_refused_where_the_other_side_has_no_numbers(tmp_path: Path, truth: np.ndarray) -> None:
    pictures(tmp_path / "p" / "v", truth)
    (tmp_path / "p" / "v" / "11.png").rename(tmp_path / "p" / "v" / "12.png")
    with pytest.raises(UserError, match="the prediction has 12 frames from 0 to 12, but no frame 11; number them"):
        score_predictions(tmp_path / "p", truth=tmp_path / "truth.npz")
    pictures(tmp_path / "late" / "v", truth, start=2)
    with pytest.raises(UserError, match=r"12 frames from 2 to 13; number them from 0 \(or 1\) on"):
        score_predictions(tmp_path / "late", truth=tmp_path / "truth.npz")
    with pytest.raises(UserError, match="the ground truth has 12 frames from 2 to 13"):
        score_predictions(tmp_path / "truth.npz", truth=tmp_path / "late")


def png(bits: int, rows: list[bytes], width: int) -> bytes:
    """A grey PNG of any depth, which Pillow does not write."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, len(rows), bits, 0, 0, 0, 0)
    data = zlib.compress(b"".join(b"\0" + row for row in rows))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def test_label_images_of_every_depth(tmp_path: Path) -> None:
    folder = tmp_path / "v"
    folder.mkdir()
    for bits, row, labels in (
        (1, bytes([0b01010000]), [0, 1, 0, 1]),
        (2, bytes([0b00011011]), [0, 1, 2, 3]),
        (4, bytes([0x01, 0x2F]), [0, 1, 2, 15]),
        (8, bytes([0, 1, 2, 255]), [0, 1, 2, 255]),
        (16, bytes([0, 1, 1, 2, 255, 255, 3, 232]), [1, 258, 65535, 1000]),
    ):
        (folder / "0.png").write_bytes(png(bits, [row], 4))
        assert read_davis(tmp_path, "v").tolist() == [[labels]]
    cv2.imwrite(str(folder / "0.png"), np.array([[0, 300, 40000]], dtype=np.uint16))
    assert read_davis(tmp_path, "v").tolist() == [[[0, 300, 40000]]]
    cv2.imwrite(str(folder / "0.png"), np.zeros((4, 4, 3), dtype=np.uint16))
    with pytest.raises(UserError, match=r"is a RGB.* image; want one index per pixel"):
        read_davis(tmp_path, "v")


def test_sixteen_bit_images_are_ground_truth(tmp_path: Path, truth: np.ndarray) -> None:
    for side, step in (("p", 500), ("t", 1000)):
        (tmp_path / side / "v").mkdir(parents=True)
        for t, frame in enumerate(truth):
            cv2.imwrite(str(tmp_path / side / "v" / f"{t}.png"), (frame * step).astype(np.uint16))
    total = score_predictions(tmp_path / "p", truth=tmp_path / "t")["total"]
    assert {key: total[key] for key in PERFECT} == PERFECT


@pytest.mark.parametrize("end", ["\n", "\n\n\n", "\r\n  \r\n", "\n\t\n", ""])
def test_blank_lines_in_mots(tmp_path: Path, end: str) -> None:
    (tmp_path / "a.txt").write_bytes(f"\ufeff1 2 2 2 2 04\n\n2 1 2 2 2 04{end}".encode())
    assert read_mots(tmp_path, "a", (2, 2, 2)).tolist() == [[[1, 1], [1, 1]], [[0, 0], [0, 0]]]
