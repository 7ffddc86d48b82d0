"""Agreement with TrackEval (tests/trackeval_python.py says how to install it)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from apex_lab.metrics import Evaluator
from apex_lab.metrics.hota import HotaCounts
from apex_lab.metrics.identity import IdentityCounts
from apex_lab.metrics.tracking import TrackingSettings, detections
from tests.trackeval_python import ask_trackeval, needs_trackeval

pytestmark = needs_trackeval


@pytest.fixture(scope="module")
def videos(make) -> list[tuple[np.ndarray, np.ndarray]]:
    pairs = list(make.some_videos(8, frames=7, side=40).values())
    pairs += [(make.noisy(found, 0.35, 7, seed), truth) for seed, (found, truth) in enumerate(pairs)]
    pairs.append((np.zeros_like(pairs[0][1]), pairs[0][1]))
    return pairs


@pytest.fixture(scope="module")
def theirs(make, videos) -> dict[str, Any]:
    question = []
    for prediction, truth in videos:
        frames = detections(make.counts_of(prediction, truth), TrackingSettings())
        rows = [{"rows": f.rows.tolist(), "columns": f.columns.tolist(), "iou": f.iou.tolist()} for f in frames]
        question.append({"frames": rows, "truth": truth.tolist(), "prediction": prediction.tolist()})
    return ask_trackeval(Path(__file__).with_name("trackeval_reference.py"), question)


def test_hota(make, videos, theirs: dict[str, Any]) -> None:
    parts = []
    for (prediction, truth), expected in zip(videos, theirs["hota"]["videos"], strict=True):
        counts = make.counts_of(prediction, truth)
        parts.append(HotaCounts.of_video(detections(counts, TrackingSettings()), counts.shape[1:]))
        compare(parts[-1], expected)
    compare(HotaCounts.total(parts), theirs["hota"]["total"])


def compare(counts: HotaCounts, expected: dict[str, Any]) -> None:
    names = {"HOTA": "hota", "DetA": "deta", "AssA": "assa", "DetRe": "detre", "DetPr": "detpr"}
    names |= {"AssRe": "assre", "AssPr": "asspr", "LocA": "loca"}
    curves = counts.curves()
    for name, ours in names.items():
        np.testing.assert_allclose(curves[ours], expected[name], rtol=0, atol=1e-9)


def test_idf1(make, videos, theirs: dict[str, Any]) -> None:
    parts = []
    for (prediction, truth), expected in zip(videos, theirs["identity"]["videos"], strict=True):
        counts = make.counts_of(prediction, truth)
        parts.append(IdentityCounts.of_video(detections(counts, TrackingSettings()), counts.shape[1:]))
        assert parts[-1].idf1() == pytest.approx(expected["IDF1"], abs=1e-9)
    assert IdentityCounts.total(parts).idf1() == pytest.approx(theirs["identity"]["total"]["IDF1"], abs=1e-9)


def test_j_and_f(videos, theirs: dict[str, Any]) -> None:
    evaluator = Evaluator()
    for i, ((prediction, truth), expected) in enumerate(zip(videos, theirs["jf"]["videos"], strict=True)):
        tracks = evaluator.add(f"v{i:02d}", prediction, truth).tracks
        assert tracks is not None
        assert tracks.objects == expected["num_gt_tracks"]
        assert tracks.j / tracks.objects == pytest.approx(expected["J-Mean"], abs=1e-9)
        assert tracks.f / tracks.objects == pytest.approx(expected["F-Mean"], abs=1e-9)
    total = evaluator.result()["total"]
    assert total["jf"] == pytest.approx(theirs["jf"]["total"]["J&F"], abs=1e-9)
