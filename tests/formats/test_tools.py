"""Every export is read by the tool that people use for it, and says there what it says here."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import motmetrics
import numpy as np
import pytest
from PIL import Image
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from apex_lab.data import P2D
from apex_lab.formats import PredictedVideo, open_writer, p2d_video_name
from apex_lab.metrics import Evaluator, EvaluatorSettings, TrackingSettings, p2d_metadata
from apex_lab.metrics.bench_scoring import synthetic_video
from sims.p2d.export import export as export_p2d
from tests.fakes.p2d_tools import make, small
from tests.trackeval_python import ask_trackeval, needs_trackeval

pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")

RAW = EvaluatorSettings(tracking=TrackingSettings(min_pixels=0, background_iou=None))
"""Tracking of all masks, as other programs do it."""


def videos(void: bool = False) -> Iterator[PredictedVideo]:
    """Three videos whose background is known; identity 900 is it."""
    for i in range(3):
        found, truth = synthetic_video(i, 5, 40, 2 + i, 6)
        found = np.where(np.isin(found, np.arange(1, 4 + i)), found, 900)
        if void:
            truth[:, 25:, :20] = 255
        yield PredictedVideo(f"v{i}", found, truth, background_ids={900})


def write(format: str, folder: Path, videos: Iterator[PredictedVideo], ignore_label: int | None = None) -> list[Path]:
    paths = []
    for truth in (False, True):
        paths.append(folder / (f"{format}{'.truth' if truth else ''}" + (".json" if format == "coco" else "")))
        with open_writer(format, paths[-1], truth, ignore_label) as writer:
            for video in videos if isinstance(videos, list) else (videos := list(videos)):
                writer.add(video)
    return paths


def masks_apart(videos: Iterator[PredictedVideo], settings: EvaluatorSettings = RAW) -> dict[str, float]:
    """Our scores of the objects alone: the background belongs to no prediction."""
    evaluator = Evaluator(replace(settings, tracking=replace(settings.tracking, drop_background_slot=True)))
    for video in videos:
        assert video.truth is not None
        evaluator.add(video.name, video.identities, video.truth, background_ids=video.background_ids)
    return evaluator.result()["total"]


def mot_config(truth: Path, tracker: Path) -> dict[str, Any]:
    return {
        "GT_FOLDER": str(truth),
        "TRACKERS_FOLDER": str(tracker.parent),
        "TRACKERS_TO_EVAL": [tracker.name],
        "TRACKER_SUB_FOLDER": "",
        "SKIP_SPLIT_FOL": True,
        "GT_LOC_FORMAT": "{gt_folder}/{seq}.txt",
        "SEQMAP_FILE": str(truth / "seqmaps" / "all.txt"),
    }


def folders(dataset: str, config: dict[str, Any]) -> dict[str, Any]:
    question = {"dataset": dataset, "config": config, "tracker": config["TRACKERS_TO_EVAL"][0]}
    (answer,) = ask_trackeval(Path(__file__).with_name("trackeval_folders.py"), [question])
    return answer


@needs_trackeval
def test_mots_in_trackeval(tmp_path: Path) -> None:
    found, truth = write("mots", tmp_path, videos())
    theirs = folders("MOTSChallenge", mot_config(truth, found))
    ours = masks_apart(videos())
    total = {name: result["COMBINED"] for name, result in theirs.items()}
    assert ours["num_objects"] > 20
    assert np.mean(total["HOTA"]["HOTA"]) == pytest.approx(ours["hota"], abs=1e-12)
    assert np.mean(total["HOTA"]["AssA"]) == pytest.approx(ours["assa"], abs=1e-12)
    assert total["Identity"]["IDF1"] == pytest.approx(ours["idf1"], abs=1e-15)
    assert 100 * total["CLEAR"]["MOTA"] == pytest.approx(ours["mota"], abs=1e-12)
    assert 100 * total["CLEAR"]["MOTP"] == pytest.approx(ours["motp"], abs=1e-12)


@needs_trackeval
def test_mots_with_a_region_to_ignore_in_trackeval(tmp_path: Path) -> None:
    """TrackEval keeps masks whole and drops what lies in the region; a perfect prediction is perfect in both."""
    perfect = [replace(v, identities=np.where(v.truth == 255, 0, v.truth), background_ids={0}) for v in videos(True)]
    found, truth = write("mots", tmp_path, perfect, ignore_label=255)
    theirs = folders("MOTSChallenge", mot_config(truth, found))
    assert theirs["CLEAR"]["COMBINED"]["MOTA"] == theirs["Identity"]["COMBINED"]["IDF1"] == 1
    assert theirs["CLEAR"]["COMBINED"]["CLR_TP"] > 20
    assert masks_apart(iter(perfect), replace(RAW, ignore_label=255))["mota"] == 100


@needs_trackeval
def test_boxes_in_trackeval_and_motmetrics(tmp_path: Path) -> None:
    found, truth = write("mot", tmp_path, videos())
    for benchmark in ("MOT17", "MOT15"):
        theirs = folders("MotChallenge2DBox", {**mot_config(truth, found), "BENCHMARK": benchmark})
        clear = theirs["CLEAR"]["COMBINED"]
        n = sum(len(np.unique(frame)) - 1 for video in videos() for frame in video.truth)
        assert clear["CLR_TP"] + clear["CLR_FN"] == n
        assert clear["CLR_TP"] > 0
    for name in ("v0", "v1", "v2"):
        gt = motmetrics.io.loadtxt(truth / f"{name}.txt", fmt="mot16", min_confidence=1)
        assert set(gt.ClassId) == {1}
        assert len(motmetrics.io.loadtxt(found / f"{name}.txt", fmt="mot15-2D"))


@pytest.fixture(scope="module")
def p2d(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("p2d")
    make(root, small(test=2, frames=4, image_size=32))
    return root


def of_p2d(root: Path) -> Iterator[PredictedVideo]:
    data = P2D(root, "test")
    for index in range(len(data)):
        labels = data[index]["segmentation"].numpy()
        objects = p2d_metadata(data.meta(index))
        yield PredictedVideo(p2d_video_name("test", index), labels, labels, background_ids={0}, objects=objects)


def test_both_exports_of_p2d_name_and_write_alike(p2d: Path, tmp_path: Path) -> None:
    export_p2d(p2d, tmp_path / "sims", "mot", ["test"], shown=False)
    _, truth = write("mot", tmp_path, of_p2d(p2d))
    names = (tmp_path / "sims" / "seqmaps" / "P2D-test.txt").read_text()
    assert names == (truth / "seqmaps" / "all.txt").read_text()
    for name in names.split()[1:]:
        official = tmp_path / "sims" / "P2D-test" / name
        theirs, ours = (sorted(f.read_text().splitlines()) for f in (official / "gt" / "gt.txt", truth / f"{name}.txt"))
        assert theirs == ours
        assert (official / "seqinfo.ini").read_text() == (truth / name / "seqinfo.ini").read_text()


@needs_trackeval
def test_boxes_against_the_truth_that_the_simulator_exports(p2d: Path, tmp_path: Path) -> None:
    export_p2d(p2d, tmp_path / "sims", "mot", ["test"], shown=False)
    found, _ = write("mot", tmp_path, of_p2d(p2d))
    config = mot_config(tmp_path / "sims", found)
    config |= {"BENCHMARK": "P2D", "SPLIT_TO_EVAL": "test", "GT_LOC_FORMAT": "{gt_folder}/{seq}/gt/gt.txt"}
    config |= {"SKIP_SPLIT_FOL": False, "SEQMAP_FILE": None}
    (tmp_path / "P2D-test").mkdir()
    found.rename(tmp_path / "P2D-test" / found.name)
    clear = folders("MotChallenge2DBox", config)["CLEAR"]["COMBINED"]
    assert clear["MOTA"] == 1
    assert clear["CLR_TP"] > 5


def test_coco_in_pycocotools(tmp_path: Path) -> None:
    found, truth = write("coco", tmp_path, videos())
    page = COCO(truth)
    results = page.loadRes(str(found))
    assert len(page.imgs) == 15
    assert [category["name"] for category in page.cats.values()] == ["object"]
    for number, video in enumerate(videos()):
        assert video.truth is not None
        for t in range(5):
            (image,) = [i for i in page.imgs.values() if (i["video_id"], i["frame_id"]) == (number, t)]
            for side, labels, background in ((page, video.truth[t], 0), (results, video.identities[t], 900)):
                drawn = np.full(labels.shape, background)
                for annotation in side.loadAnns(side.getAnnIds(image["id"])):
                    mask = side.annToMask(annotation).astype(bool)
                    drawn[mask] = annotation["track_id"]
                    assert annotation["area"] == mask.sum()
                np.testing.assert_array_equal(drawn, labels)


def test_coco_average_precision_of_a_perfect_prediction(p2d: Path, tmp_path: Path) -> None:
    found, truth = write("coco", tmp_path, of_p2d(p2d))
    export_p2d(p2d, tmp_path / "sims", "coco", ["test"], shown=False)
    for page, categories in ((COCO(truth), 1), (COCO(tmp_path / "sims" / "annotations" / "instances_test.json"), 0)):
        evaluation = COCOeval(page, page.loadRes(str(found)), "segm")
        evaluation.params.useCats = categories
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
        assert evaluation.stats[0] == pytest.approx(1)


@needs_trackeval
def test_davis_in_trackeval_and_pil(tmp_path: Path) -> None:
    found, truth = write("davis", tmp_path, videos(void=True), ignore_label=255)
    config = {"GT_FOLDER": str(truth), "TRACKERS_FOLDER": str(tmp_path), "TRACKERS_TO_EVAL": [found.name]}
    theirs = folders("DAVIS", {**config, "TRACKER_SUB_FOLDER": ""})["JAndF"]["COMBINED"]
    ours = masks_apart(videos(void=True), replace(RAW, ignore_label=255))
    # TrackEval has no track for the background, which no object is assigned here either.
    assert theirs["J-Mean"] == pytest.approx(ours["j"], abs=1e-12)
    assert theirs["F-Mean"] == pytest.approx(ours["f"], abs=1e-9)
    for video in videos(void=True):
        for t, frame in enumerate(video.truth):
            with Image.open(truth / video.name / f"{t:05d}.png") as image:
                assert image.mode == "P"
                np.testing.assert_array_equal(np.asarray(image), frame)


def test_npz_in_numpy(tmp_path: Path) -> None:
    (path, _) = write("npz", tmp_path, videos())
    arrays = np.load(path)
    for video in videos():
        masks, ids = arrays[f"{video.name}__masks"], arrays[f"{video.name}__ids"]
        found = np.take_along_axis(ids[:, :, None], masks.argmax(axis=1).reshape(5, 1, -1), axis=1)
        np.testing.assert_array_equal(found.reshape(5, 40, 40), video.identities)
