"""Pixels of `ignore_label` are left out of every metric."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from sklearn.metrics import adjusted_rand_score

from apex_lab.base.order import natural_key
from apex_lab.metrics import (
    KEYS,
    AdjustedRandIndex,
    Evaluator,
    EvaluatorSettings,
    SceneMetrics,
    SegmentationCovering,
    ari,
    ari_fg,
    covering,
    link_frames,
)
from apex_lab.metrics.ignored import likely_void

VOID = 255


def result(prediction: np.ndarray, truth: np.ndarray, **settings: Any) -> dict[str, Any]:
    evaluator = Evaluator(EvaluatorSettings(per_frame=True, events=True, **settings))
    evaluator.add("v", prediction, truth)
    return evaluator.result()


def same(first: dict[str, Any], second: dict[str, Any], but: tuple[str, ...] = ()) -> None:
    for name, value in first.items():
        if name not in but:
            assert second[name] == pytest.approx(value, abs=1e-12, nan_ok=True), name


@pytest.fixture
def clip(make) -> tuple[np.ndarray, np.ndarray]:
    found, truth = make.some_videos(4, frames=6, side=40)["v3"]
    return make.noisy(found, 0.05, 6, 0), truth


@pytest.fixture
def holes() -> np.ndarray:
    """Irregular regions that change from frame to frame, and one frame without a hole."""
    rng = np.random.default_rng(0)
    holes = rng.random((6, 5, 5)).repeat(8, axis=1).repeat(8, axis=2) < 0.3
    holes[2] = False
    return holes


@pytest.mark.parametrize("identities", ["own", "none", "linked"])
@pytest.mark.parametrize("label", [255, 7, -1, 65535])
def test_what_is_predicted_there_changes_no_number(clip, holes, identities: str, label: int) -> None:
    found, truth = clip
    truth = np.where(holes, label, truth)
    rng = np.random.default_rng(1)
    settings = {"identities": identities, "ignore_label": label}
    first = result(found, truth, **settings)
    for other in (np.where(holes, 3, found), np.where(holes, 70 + rng.integers(0, 9, truth.shape), found)):
        second = result(other, truth, **settings)
        same(first["total"], second["total"])
        assert str(first["hota_alpha"]) == str(second["hota_alpha"])
        assert first["per_object"].equals(second["per_object"])
        for here, there in zip(first["per_frame"], second["per_frame"], strict=True):
            same(here, there)
    assert label not in first["per_object"]["label"].tolist()
    assert first["settings"]["ignore_label"] == label


def test_a_border_that_is_ignored_counts_like_a_border_cut_off(clip) -> None:
    found, truth = clip
    marked = truth.copy()
    marked[:, 30:] = VOID
    first, second = result(found, marked, ignore_label=VOID), result(found[:, :30], truth[:, :30])
    # The tolerance of F is a share of the image's diagonal.
    same(first["total"], second["total"], but=("f", "jf"))
    assert first["total"]["ari"] != result(found, truth)["total"]["ari"]
    same(result(found, np.where(marked == VOID, -1, marked), ignore_label=-1)["total"], first["total"])


def test_a_perfect_prediction_is_perfect(clip, holes) -> None:
    _, truth = clip
    total = result(truth, np.where(holes, VOID, truth), ignore_label=VOID)["total"]
    for name in ("ari", "ari_fg", "msc", "msc_fg", "sc", "mbo", "miou", "video_ari", "hota", "idf1", "j", "f", "jf"):
        assert total[name] == 1, name
    assert total["mota"] == total["motp"] == 100
    scored = result(truth, np.where(holes, VOID, truth))["total"]
    assert scored["msc_fg"] < 0.95
    assert scored["mota"] < 100


def test_a_frame_without_any_other_pixel_is_left_out(clip) -> None:
    found, truth = clip
    marked = truth.copy()
    marked[4] = VOID
    rest = [0, 1, 2, 3, 5]
    first, second = result(found, marked, ignore_label=VOID), result(found[rest], truth[rest])
    same(first["total"], second["total"], but=("frames", "empty_frames", "num_frames", "num_frames_start2"))
    row = first["per_frame"][4]
    assert all(math.isnan(row[name]) for name in ("ari", "ari_fg", "msc", "msc_fg", "mbo", "j", "jf"))
    nothing = result(found, np.full_like(truth, VOID), ignore_label=VOID)["total"]
    assert all(math.isnan(nothing[name]) for name in ("ari", "msc_fg", "video_ari", "mota", "hota", "jf", "idf1"))


def test_the_background_can_be_the_ignored_label(clip) -> None:
    found, truth = clip
    total = result(found, truth, ignore_label=0)["total"]
    assert total["ari"] == pytest.approx(total["ari_fg"])
    assert total["msc"] == pytest.approx(total["msc_fg"])


def test_functions_and_classes_leave_it_out_too(clip, holes) -> None:
    found, truth = clip
    marked = np.where(holes, VOID, truth)
    tensors = torch.from_numpy(found)[None], torch.from_numpy(marked)[None]
    expected = [adjusted_rand_score(t[~h], f[~h]) for t, f, h in zip(truth, found, holes, strict=True)]
    assert ari(*tensors, ignore_label=VOID)[0].tolist() == pytest.approx(expected)
    table = AdjustedRandIndex(ignore_label=VOID)
    table.update(*tensors)
    assert float(table.compute()) == pytest.approx(np.mean(expected))
    metrics = SceneMetrics(ignore_label=VOID)
    metrics.update(*tensors)
    assert metrics.compute()["ari"] == pytest.approx(np.mean(expected))
    total = result(found, marked, ignore_label=VOID)["total"]
    assert metrics.compute() == pytest.approx({name: total[name] for name in metrics.names})
    covered = SegmentationCovering(background=False, ignore_label=VOID)
    covered.update(*tensors)
    assert float(covered.compute()) == pytest.approx(total["msc_fg"])
    assert covering(*tensors, ignore_label=VOID).mean().item() == pytest.approx(total["msc"])
    assert ari_fg(*tensors, mode="sequence", ignore_label=VOID).item() == pytest.approx(total["video_ari_fg"])
    # -1 and 255 are one byte, and two labels
    bytes_ = torch.from_numpy(marked.astype(np.uint8))[None]
    assert ari(tensors[0], bytes_, ignore_label=-1).tolist() == ari(*tensors).tolist()


def test_links_do_not_look_there(make) -> None:
    """A segment is the same one as before by the pixels that count, and not by those that do not."""
    found = make.strip([1, 1, 2, 2], [3, 4, 4, 4])
    holes = make.strip([0, 1, 0, 0], [0, 1, 0, 0]).astype(bool)
    assert link_frames(found)[1, 0, ::8].tolist() == [0, 1, 1, 1]
    assert link_frames(found, holes)[1, 0, [0, 16, 24]].tolist() == [0, 1, 1]
    other = np.where(holes, 9, found)
    kept = ~holes
    assert link_frames(found, holes)[kept].tolist() == link_frames(other, holes)[kept].tolist()


def test_a_negative_label_is_refused_with_the_way_out(clip) -> None:
    found, truth = clip
    with pytest.raises(ValueError, match=r"negative label -1; .* set ignore_label=-1 \(scoring.ignore_label=-1"):
        result(found, np.where(truth == 1, -1, truth))
    with pytest.raises(ValueError, match="negative label -2"):
        result(found, np.where(truth == 1, -2, truth), ignore_label=-1)


def test_settings_without_the_key_are_what_they_were(clip) -> None:
    found, truth = clip
    assert "ignore_label" not in KEYS
    same(result(found, truth)["total"], result(found, truth, ignore_label=VOID)["total"])


def test_labels_that_look_like_void() -> None:
    assert likely_void(np.array([[[0, 1, 255]]])) == 255
    assert likely_void(np.array([[[0, 255]]], dtype=np.uint8)) == 255
    assert likely_void(np.array([[[0, 300, 65535]]])) == 65535
    assert likely_void(np.array([[[0, 254, 255]]])) is None
    assert likely_void(np.array([[[0, 1, 2]]])) is None


def test_natural_order() -> None:
    names = ["v10", "v9", "a", "v1_10", "v1_9", "v01", "v1", "3", "20", ""]
    assert sorted(names, key=natural_key) == ["", "3", "20", "a", "v01", "v1", "v1_9", "v1_10", "v9", "v10"]
    evaluator = Evaluator()
    for name in ("v10", "v9"):
        evaluator.add(name, np.zeros((1, 4, 4), dtype=int), np.zeros((1, 4, 4), dtype=int))
    assert [row["video"] for row in evaluator.result()["per_video"]] == ["v9", "v10"]
