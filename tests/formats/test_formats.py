from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pycocotools import mask as pycoco

from apex_lab.base.errors import UserError
from apex_lab.formats import EXPORTS, PredictedVideo, open_truth, open_writer, score_predictions
from apex_lab.formats.davis import palette, read_davis
from apex_lab.formats.mots import read_mots
from apex_lab.formats.rle import decode, encode
from apex_lab.formats.truth import load_json
from apex_lab.formats.weis import read_weis
from apex_lab.metrics.bench_scoring import synthetic_video


def videos() -> Iterator[PredictedVideo]:
    for i in range(3):
        prediction, truth = synthetic_video(i, 4, 32, 1 + i, 6)
        yield PredictedVideo(f"v{i}", prediction + 40 * i, truth)


@pytest.fixture
def npz(tmp_path: Path) -> Path:
    return export("npz", tmp_path / "all.npz")


def export(format: str, path: Path, truth: bool = False) -> Path:
    with open_writer(format, path, truth) as writer:
        for video in videos():
            writer.add(video)
    return path


NAMES = {"coco": "p.json", "weis": "p.json", "davis": "davis", "mots": "mots"}


@pytest.mark.parametrize("format", NAMES)
def test_every_format_gives_the_same_numbers(tmp_path: Path, npz: Path, format: str) -> None:
    path = export(format, tmp_path / NAMES[format])
    with pytest.raises(UserError, match="holds no ground truth; name it with truth="):
        score_predictions(path)
    found, expected = score_predictions(path, truth=npz), score_predictions(npz)
    assert found["total"] == pytest.approx(expected["total"], abs=1e-12)
    assert [row["video"] for row in found["per_video"]] == ["v0", "v1", "v2"]
    assert found["source"]["format"] == format
    assert score_predictions(path, truth=npz, format="coco" if format == "weis" else format)["total"] == found["total"]


def test_davis_pictures_as_ground_truth(tmp_path: Path, npz: Path) -> None:
    truth = export("davis", tmp_path / "truth", truth=True)
    for name in open_truth(truth).names:
        np.testing.assert_array_equal(open_truth(truth).labels(name), open_truth(npz).labels(name))
    assert score_predictions(npz, truth=truth)["total"] == score_predictions(npz)["total"]


def test_weis_files_hold_what_the_public_program_reads(tmp_path: Path) -> None:
    predictions = json.loads(export("weis", tmp_path / "p.json").read_text())
    truths = json.loads(export("weis", tmp_path / "t.json", truth=True).read_text())
    seen: dict[str, set[int]] = {"p": set(), "t": set()}
    for video, frames, true_frames in zip(videos(), predictions, truths, strict=True):
        assert video.truth is not None
        mine: dict[str, set[int]] = {"p": set(), "t": set()}
        for t, (frame, true_frame) in enumerate(zip(frames, true_frames, strict=True)):
            mine["p"] |= set(frame["ids"])
            mine["t"] |= set(true_frame["ids"])
            assert set(frame) == {"masks", "ids"}
            assert true_frame["num_bg"] == 1
            masks = [row_runs(runs, (32, 32)) for runs in true_frame["masks"]]
            np.testing.assert_array_equal(masks[-1], video.truth[t] == 0)
            assert sum(masks).max() == 1
        assert not (seen["p"] & mine["p"])
        assert not (seen["t"] & mine["t"])
        seen = {side: seen[side] | mine[side] for side in seen}


def row_runs(runs: str, shape: tuple[int, int]) -> np.ndarray:
    """Decodes 'start length ...' as the format says: rows first, counted from 1."""
    words = [int(word) for word in runs.split()]
    flat = np.zeros(shape[0] * shape[1], dtype=int)
    for start, length in zip(words[::2], words[1::2], strict=True):
        flat[start - 1 : start - 1 + length] = 1
    return flat.reshape(shape)


def test_a_background_too_small_for_the_public_program_is_left_out(tmp_path: Path) -> None:
    truth = np.ones((1, 4, 4), dtype=np.int64)
    truth[0, 0] = 0
    for rows, number in ((1, 0), (2, 1)):
        truth[0, :rows] = 0
        with open_writer("weis", tmp_path / "t.json", truth=True) as writer:
            writer.add(PredictedVideo("a", truth, truth))
        ((frame,),) = json.loads((tmp_path / "t.json").read_text())
        assert frame["num_bg"] == number
        assert len(frame["ids"]) == 1 + number


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
@pytest.mark.parametrize("seed", range(5))
def test_run_lengths_agree_with_pycocotools(seed: int) -> None:
    rng = np.random.default_rng(seed)
    masks = rng.random((4, 9, 13)) < rng.random()
    masks[0], masks[1] = False, True
    for mask, rle in zip(masks, encode(masks), strict=True):
        np.testing.assert_array_equal(decode(rle, (9, 13), "here"), mask)
        np.testing.assert_array_equal(pycoco.decode(rle), mask)
        columns = mask.T.ravel()
        edges = np.flatnonzero(np.diff(columns)) + 1
        counts = np.diff([0, *edges, columns.size]).tolist()
        plain = {"size": [9, 13], "counts": [0, *counts] if columns[0] else counts}
        np.testing.assert_array_equal(decode(plain, (9, 13), "here"), mask)


def test_long_runs() -> None:
    masks = np.zeros((2, 300, 400), dtype=bool)
    masks[0, :, 100:300] = True
    masks[1, 7, ::3] = True
    for mask, rle in zip(masks, encode(masks), strict=True):
        np.testing.assert_array_equal(decode(rle, (300, 400), "here"), mask)


def test_pixels_of_no_mask_are_one_more_segment(tmp_path: Path) -> None:
    prediction = np.array([[[5, 5, 0, 0]], [[5, 0, 0, 7]]])
    path = tmp_path / "mots"
    with open_writer("mots", path) as writer:
        writer.add(PredictedVideo("a", prediction, background_ids=[0]))
    assert read_mots(path, "a", (2, 1, 4)).tolist() == [[[5, 5, 8, 8]], [[5, 8, 8, 7]]]
    (path / "a.txt").write_text("")
    assert read_mots(path, "a", (1, 1, 2)).tolist() == [[[0, 0]]]


def test_boxes(tmp_path: Path, npz: Path) -> None:
    prediction = np.zeros((2, 6, 8), dtype=np.int64)
    prediction[0, 1:4, 2:7] = 3
    with open_writer("mot", tmp_path / "mot") as writer:
        writer.add(PredictedVideo("v0", prediction, background_ids=[0]))
        writer.add(PredictedVideo("other", prediction))
    assert (tmp_path / "mot" / "v0.txt").read_text() == "1,4,3,2,5,3,1,-1,-1,-1\n"
    assert (tmp_path / "mot" / "other.txt").read_text().splitlines()[0] == "1,1,1,1,8,6,1,-1,-1,-1"
    (tmp_path / "mot" / "other.txt").unlink()
    with pytest.raises(UserError, match=r"v0\.txt, line 1: MOTChallenge boxes hold no masks and cannot be scored"):
        score_predictions(tmp_path / "mot", truth=npz, partial=True)


def test_palette_pictures(tmp_path: Path) -> None:
    prediction = np.array([[[900, 4, 17]]])
    for background, indices in (([], [3, 1, 2]), ([17], [2, 1, 0])):
        with open_writer("davis", tmp_path) as writer:
            writer.add(PredictedVideo("a", prediction, background_ids=background))
        image = Image.open(tmp_path / "a" / "00000.png")
        assert image.mode == "P"
        assert np.asarray(image).tolist() == [indices]
        assert image.getpalette()[:12] == [0, 0, 0, 128, 0, 0, 0, 128, 0, 128, 128, 0]
    assert palette()[255].tolist() == [224, 224, 192]
    assert read_davis(tmp_path, "a").tolist() == [[[2, 1, 0]]]
    with pytest.raises(UserError, match="has 256 identities, a palette image tells 254 apart"), writer:
        writer.add(PredictedVideo("b", np.arange(256).reshape(1, 16, 16)))
    with pytest.raises(UserError, match="'a/b' cannot be a file name"), writer:
        writer.add(PredictedVideo("a/b", prediction))


def test_writing_again_replaces(tmp_path: Path) -> None:
    for frames in (3, 2):
        with open_writer("davis", tmp_path) as writer:
            writer.add(PredictedVideo("a", np.zeros((frames, 2, 2), dtype=np.int64)))
    assert len(list((tmp_path / "a").iterdir())) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("format", ["coco", "weis", "davis", "mots", "mot"])
def test_ground_truth_that_is_not_there(tmp_path: Path, format: str) -> None:
    with (
        pytest.raises(ValueError, match="video 'a' has no ground truth"),
        open_writer(format, tmp_path / "x", True) as w,
    ):
        w.add(PredictedVideo("a", np.zeros((1, 2, 2), dtype=np.int64)))


def test_an_export_of_nothing(tmp_path: Path) -> None:
    with open_writer("coco", tmp_path / "p.json"):
        pass
    assert json.loads((tmp_path / "p.json").read_text()) == []
    with open_writer("weis", tmp_path / "p.json"):
        pass
    assert json.loads((tmp_path / "p.json").read_text()) == []
    with pytest.raises(UserError, match="no export format 'gif'"):
        open_writer("gif", tmp_path)
    assert "mot" in EXPORTS


RLE = encode(np.ones((1, 2, 2), dtype=bool))[0]
BAD_WEIS: dict[str, tuple[Any, str]] = {
    "no list": ([{"videos": []}], "must hold a list of videos"),
    "videos": ([], "holds 0 videos, the ground truth 1"),
    "frames": ([[]], "video 0: has 0 frames, the ground truth 1"),
    "keys": ([[{"ids": [1]}]], "video 0, frame 0: want"),
    "lengths": ([[{"ids": [1, 2], "masks": [RLE]}]], "of one length"),
    "id": ([[{"ids": [-1], "masks": [RLE]}]], "the id -1 is no integer >= 0"),
    "kind of id": ([[{"ids": ["a"], "masks": [RLE]}]], "the id 'a' is no integer"),
    "twice": ([[{"ids": [3, 3], "masks": [RLE, RLE]}]], "has the id 3 more than once"),
    "overlap": ([[{"ids": [3, 4], "masks": [RLE, RLE]}]], "frame 0, id 4: the mask covers pixels of another"),
    "size": ([[{"ids": [3], "masks": [{**RLE, "size": [4, 1]}]}]], "a mask is 4 x 1, the ground truth 2 x 2"),
    "runs": ([[{"ids": [3], "masks": [{**RLE, "counts": "01"}]}]], "do not fill its 2 x 2 pixels"),
    "empty": ([[{"ids": [3], "masks": [{**RLE, "counts": ""}]}]], "do not fill"),
    "letters": ([[{"ids": [3], "masks": [{**RLE, "counts": "0 ~"}]}]], "no run-length encoding"),
    "cut": ([[{"ids": [3], "masks": [{**RLE, "counts": "0P"}]}]], "no run-length encoding"),
    "list": ([[{"ids": [3], "masks": [{**RLE, "counts": [0, "a"]}]}]], "no run-length encoding"),
    "kind": ([[{"ids": [3], "masks": [7]}]], "no run-length encoding"),
    "polygon": ([[{"ids": [3], "masks": [[[0, 0, 1, 0, 1, 1]]]}]], "polygons are not read, give run-length encodings"),
    "outside": ([[{"ids": [3], "masks": ["3 4"]}]], "a run of 4 pixels from 3 on does not lie in an image of 2 x 2"),
    "odd": ([[{"ids": [3], "masks": ["3"]}]], "'3' is no list of starts and lengths"),
}


@pytest.mark.parametrize("case", BAD_WEIS)
def test_malformed_json(tmp_path: Path, case: str) -> None:
    content, message = BAD_WEIS[case]
    path = tmp_path / "p.json"
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match=message):
        list(read_weis(load_json(path), path, [(1, 2, 2)]))


def test_files_that_are_no_json(tmp_path: Path, npz: Path) -> None:
    path = tmp_path / "p.json"
    with pytest.raises(UserError, match="there is no file"):
        load_json(path)
    path.write_text("[[")
    with pytest.raises(UserError, match="no readable JSON"):
        score_predictions(path, truth=npz)
    path.write_text("[]")
    with pytest.raises(UserError, match="resize=masks needs soft masks"):
        score_predictions(path, truth=npz, resize="masks")
    with pytest.raises(UserError, match="resize=truth does not go with"):
        score_predictions(path, truth=npz, resize="truth")


BAD_MOTS = {
    "0 1 1 2 2 04": "frame 0 is none: MOTS counts frames from 1",
    "1 0 1 2 2 04": "with an id from 1",
    "1 1 1 2": "want 'frame id class height width mask'",
    "1 1 1 2 3 04": "a mask is 2 x 3, the ground truth 2 x 2",
    "1 1 1 2 2 04\n1 1 1 2 2 04": "line 2: frame 1 has the id 1 more than once",
    "1 1 1 2 2 04\n1 2 1 2 2 04": "line 2: the mask covers pixels of another",
}


@pytest.mark.parametrize("text", BAD_MOTS)
def test_malformed_mots(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(UserError, match=BAD_MOTS[text]):
        read_mots(tmp_path, "a", (1, 2, 2))


def test_malformed_pictures(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="has no folder a with PNGs"):
        read_davis(tmp_path, "a")
    (tmp_path / "a").mkdir()
    Image.new("L", (4, 4)).save(tmp_path / "a" / "0.png")
    Image.new("L", (4, 5)).save(tmp_path / "a" / "1.png")
    with pytest.raises(UserError, match=r"1\.png has the size \(5, 4\), the first frame \(4, 4\)"):
        read_davis(tmp_path, "a")
    Image.new("RGB", (4, 4)).save(tmp_path / "a" / "1.png")
    with pytest.raises(UserError, match="is a RGB image; want one index per pixel"):
        read_davis(tmp_path, "a")
    (tmp_path / "a" / "1.png").write_bytes(b"nothing")
    with pytest.raises(UserError, match="no readable PNG"):
        read_davis(tmp_path, "a")


@pytest.mark.parametrize("score", ["high", math.nan, None, True])
def test_a_score_that_is_no_number(tmp_path: Path, npz: Path, score: object) -> None:
    path = export("coco", tmp_path / "p.json")
    results = json.loads(path.read_text())
    results[1]["score"] = score
    path.write_text(json.dumps(results))
    with pytest.raises(UserError, match=r"p\.json, result 1: score is .*; want a number"):
        score_predictions(path, truth=npz)


def test_a_file_for_a_format_of_folders(npz: Path) -> None:
    with pytest.raises(UserError, match=r"format = davis wants a folder, and .*\.npz is a file"):
        score_predictions(npz, format="davis")


def test_ground_truth_of_no_kind(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no ground truth: want an npz file"):
        open_truth(tmp_path)
    with pytest.raises(UserError, match="holds no ground truth"):
        open_truth(tmp_path / "nowhere")
    with pytest.raises(UserError, match="nor a folder with"):
        score_predictions(tmp_path)
