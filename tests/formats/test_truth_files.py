"""What is exported as ground truth is ground truth, with and without a label to ignore."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.formats import PredictedVideo, open_truth, open_writer, score_predictions
from apex_lab.metrics import EvaluatorSettings
from apex_lab.metrics.bench_scoring import synthetic_video
from sims.p2d.export import export as export_p2d
from tests.fakes.p2d_tools import make, small

FORMATS = {"npz": "t.npz", "coco": "t.json", "weis": "t.json", "davis": "davis", "mots": "mots"}


def some_videos(void: int | None = None) -> list[PredictedVideo]:
    videos = []
    for i in range(3):
        prediction, truth = synthetic_video(i, 4, 32, 1 + i, 6)
        truth[-1] = 0  # the last frame is empty
        if void is not None:
            truth[:3, 20:, :20] = void
        videos.append(PredictedVideo(f"v{i}", prediction + 40 * i, truth))
    return videos


def write(format: str, path: Path, videos: list[PredictedVideo], truth: bool = False, void: int | None = None) -> Path:
    with open_writer(format, path, truth, void) as writer:
        for video in videos:
            writer.add(video)
    return path


@pytest.fixture
def warned(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    said: list[str] = []
    monkeypatch.setattr(console, "warn", said.append)
    return said


@pytest.mark.parametrize("format", FORMATS)
def test_own_truth_files_are_truth(tmp_path: Path, format: str, warned: list[str]) -> None:
    videos = some_videos()
    truth = open_truth(write(format, tmp_path / FORMATS[format], videos, truth=True))
    assert truth.names == ["v0", "v1", "v2"]
    for video in videos:
        np.testing.assert_array_equal(truth.labels(video.name), video.truth)
        assert truth.metadata(video.name) is None
    predictions = write("npz", tmp_path / "p.npz", videos)
    expected = score_predictions(predictions)["total"]
    assert score_predictions(predictions, truth=tmp_path / FORMATS[format])["total"] == expected
    for other, name in (("coco", "p.json"), ("weis", "p.json"), ("mots", "pm"), ("davis", "pd")):
        found = score_predictions(write(other, tmp_path / name, videos), truth=tmp_path / FORMATS[format])["total"]
        assert found == pytest.approx(expected, abs=1e-12)
    assert warned == []


@pytest.mark.parametrize(
    ("format", "void"),
    [
        *((format, void) for format in FORMATS for void in (255, -1)),
        *(pytest.param(format, 77, marks=() if format in ("npz", "mots") else pytest.mark.slow) for format in FORMATS),
    ],
)
def test_an_ignored_label_in_every_format(tmp_path: Path, format: str, void: int, warned: list[str]) -> None:
    videos = some_videos(void)
    predictions = write("npz", tmp_path / "p.npz", videos)
    expected = score_predictions(predictions, settings=EvaluatorSettings(ignore_label=void))["total"]
    assert expected != score_predictions(write("npz", tmp_path / "q.npz", some_videos()))["total"]
    truth = write(format, tmp_path / FORMATS[format], videos, truth=True, void=void)
    number = {"davis": 255, "mots": void if void > 0 else 10000}.get(format, void)
    settings = EvaluatorSettings(ignore_label=number)
    assert score_predictions(predictions, truth=truth, settings=settings)["total"] == expected
    for other, name in (("coco", "p.json"), ("weis", "p.json"), ("mots", "pm"), ("davis", "pd")):
        found = score_predictions(write(other, tmp_path / name, videos), truth=truth, settings=settings)["total"]
        assert found == pytest.approx(expected, abs=1e-12)
    assert warned == []
    if number == -1:
        with pytest.raises(UserError, match=r"scoring\.ignore_label leaves pixels of one label out"):
            score_predictions(predictions, truth=truth)
    elif format in ("coco", "weis", "mots") or number == 255:  # nothing tells 77 from an object in an array
        score_predictions(predictions, truth=truth)
        (said,) = warned
        assert f"{truth}: label {number} was scored as an object in 3 videos, first in 'v0'" in said
        assert f"set scoring.ignore_label={number}" in said


def test_what_the_simulator_exports_is_truth(tmp_path: Path) -> None:
    make(tmp_path / "p2d", small(test=2, frames=3, image_size=16))
    export_p2d(tmp_path / "p2d", tmp_path / "coco", "coco", ["test"], shown=False)
    ours, known = open_truth(tmp_path / "coco" / "annotations" / "instances_test.json"), open_truth(tmp_path / "p2d")
    assert ours.names == known.names == ["test_00000", "test_00001"]
    for name in ours.names:
        np.testing.assert_array_equal(ours.labels(name), known.labels(name))
    export_p2d(tmp_path / "p2d", tmp_path / "mot", "mot", ["test"], shown=False)
    boxes = open_truth(tmp_path / "mot" / "P2D-test")
    with pytest.raises(UserError, match=r"gt\.txt, line 1: MOTChallenge boxes hold no masks and cannot be scored"):
        boxes.labels("test_00000")


def test_mots_truth_of_others(tmp_path: Path) -> None:
    folder = tmp_path / "t" / "0002" / "gt"
    folder.mkdir(parents=True)
    (folder / "gt.txt").write_text("1 2001 2 2 2 04\n3 10000 10 2 2 04\n")
    truth = open_truth(tmp_path / "t")
    assert truth.names == ["0002"]
    assert truth.labels("0002")[:, 0, 0].tolist() == [2001, 0, 10000]
    assert truth.void("0002") == 10000
    (folder.parent / "seqinfo.ini").write_text("[Sequence]\nseqLength=4\nimWidth=2\nimHeight=2\n")
    assert truth.labels("0002").shape == (4, 2, 2)
    (folder.parent / "seqinfo.ini").write_text("[Sequence]\nseqLength=2\nimWidth=2\nimHeight=2\n")
    with pytest.raises(UserError, match=r"line 2: frame 3 is none of the 2 of seqinfo\.ini"):
        truth.labels("0002")
    (folder.parent / "seqinfo.ini").write_text("[Sequence]\nseqLength=x\n")
    with pytest.raises(UserError, match=r"seqinfo\.ini does not tell seqLength"):
        truth.labels("0002")
    (folder.parent / "seqinfo.ini").unlink()
    (folder / "gt.txt").write_text("")
    with pytest.raises(UserError, match="holds no mask, so the size of the video is not known"):
        truth.labels("0002")


@pytest.fixture
def coco(tmp_path: Path) -> tuple[Path, Path]:
    videos = some_videos()
    return write("coco", tmp_path / "p.json", videos), write("coco", tmp_path / "t.json", videos, truth=True)


def test_videos_without_results_hold_nothing_or_are_left_out(coco: tuple[Path, Path], warned: list[str]) -> None:
    found, truth = coco
    results = [result for result in json.loads(found.read_text()) if result["video_id"] != 1]
    found.write_text(json.dumps(results))
    assert score_predictions(found, truth=truth, partial=True)["total"]["videos"] == 2
    assert warned == []
    total = score_predictions(found, truth=truth)
    assert total["total"]["videos"] == 3
    assert total["per_video"][1]["num_matches"] == 0
    assert "1 of 3 videos have no result, the first is 'v1'; they are scored as videos in which nothing" in warned[0]


BAD_RESULTS: dict[str, tuple[Any, str]] = {
    "page": ({"annotations": []}, "must hold a list: of results"),
    "image": ([{"image_id": 99}], "result 0: track_id is None; want an integer"),
    "unknown": ([{"image_id": 99, "track_id": 1, "segmentation": ""}], "image 99 is none of the 12 images"),
    "boxes": ([{"image_id": 0, "track_id": 1, "bbox": []}], "the key segmentation is missing; boxes hold no masks"),
    "twice": ([{"image_id": 0, "track_id": 1, "segmentation": "1 2"}] * 2, "has the track_id 1 more than once"),
    "overlap": (
        [{"image_id": 0, "track_id": t, "segmentation": "1 2"} for t in (1, 2)],
        "result 1: the mask covers pixels of another",
    ),
    "mixed": ([{"image_id": 0}, 7], "must hold a list of videos"),
}


@pytest.mark.parametrize("case", BAD_RESULTS)
def test_malformed_results(coco: tuple[Path, Path], case: str) -> None:
    content, told = BAD_RESULTS[case]
    coco[0].write_text(json.dumps(content))
    with pytest.raises(UserError, match=told) as caught:
        score_predictions(coco[0], truth=coco[1])
    assert "p.json" in str(caught.value)


def test_malformed_truth(coco: tuple[Path, Path], tmp_path: Path) -> None:
    page = json.loads(coco[1].read_text())
    image, mask = page["images"][0], page["annotations"][0]
    for change, told in (
        ({"videos": None}, "ground truth in COCO's layout needs videos"),
        ({"images": [{"id": 0}]}, "lacks 'video_id'"),
        ({"images": [image, {**image, "id": 1}]}, "video 'v0' has no image, two of one frame_id"),
        ({"images": [image, {**image, "id": 1, "frame_id": 1, "width": 9}]}, "differ in size"),
        ({"annotations": [{**mask, "track_id": 0}]}, "the track_id is 0, 0 is the background"),
        ({"annotations": [{**mask, "image_id": 99}]}, "there is no image 99"),
    ):
        coco[1].write_text(json.dumps({**page, **change}))
        with pytest.raises(UserError, match=told):
            open_truth(coco[1])
    write("weis", tmp_path / "w.json", some_videos())
    with pytest.raises(UserError, match="do not all have the keys video, size and labels"):
        open_truth(tmp_path / "w.json")
    (tmp_path / "w.json").write_text("[3]")
    with pytest.raises(UserError, match="holds no ground truth: want an object with videos"):
        open_truth(tmp_path / "w.json")
