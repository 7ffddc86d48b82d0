from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from apex_lab.metrics.contingency import contingency
from apex_lab.metrics.hota import ALPHAS, HotaCounts
from apex_lab.metrics.tracking import TrackingSettings, detections

NAMES = ("hota", "deta", "assa", "detre", "detpr", "assre", "asspr", "loca")


def hota_of(prediction: np.ndarray, truth: np.ndarray) -> HotaCounts:
    counts = contingency(torch.from_numpy(prediction)[None], torch.from_numpy(truth)[None]).counts[0].numpy()
    return HotaCounts.of_video(detections(counts, TrackingSettings()), counts.shape[1:])


def test_public_values(public, video: str) -> None:
    counts = hota_of(public.identities(video), public.truth(video))
    means = counts.means()
    for theirs, expected in public.values(video)["hota"].items():
        name = "hota0" if theirs == "HOTA(0)" else theirs.lower()
        assert means[name] == pytest.approx(expected, rel=0, abs=1e-9)
    curve = public.arrays[f"{video}__hota_alpha"]
    np.testing.assert_allclose(counts.curves()["hota"], curve, rtol=0, atol=1e-9)


def test_public_values_of_all_videos(public) -> None:
    parts = [hota_of(public.identities(video), public.truth(video)) for video in public.names]
    total = HotaCounts.total(parts).means()
    for theirs, expected in public.expected["aggregate"]["hota_combined"].items():
        assert total[theirs.lower()] == pytest.approx(expected, rel=0, abs=1e-9)
    assert total["hota"] != pytest.approx(np.mean([part.means()["hota"] for part in parts]), abs=1e-3)
    assert HotaCounts.total(reversed(parts)).means() == total


def test_half_a_track_under_each_of_two_names(make) -> None:
    """Every mask exact: DetA 1, and each true positive has A = 5 / 10."""
    truth = make.strip(*[[0, 1]] * 10)
    found = make.strip(*[[7, 8]] * 5, *[[7, 9]] * 5)
    means = hota_of(found, truth).means()
    assert means["deta"] == means["loca"] == means["asspr"] == 1
    assert means["assa"] == means["assre"] == 0.5
    assert means["hota"] == pytest.approx(math.sqrt(0.5))


def test_an_iou_on_a_threshold_counts(make) -> None:
    truth, found = make.strip([0] * 5 + [1] * 20), make.strip([9] * 5 + [1] * 7 + [2] * 13)
    found[0, 0, :40] = 9
    curve = hota_of(found, truth).true_positives  # IoU of the better half: 13/20 = 0.65
    assert curve.tolist() == [int(alpha <= 0.65 + 1e-9) for alpha in ALPHAS]


def test_without_predictions_and_without_objects(make) -> None:
    truth = make.strip(*[[0] * 9 + [1]] * 2)
    nothing = hota_of(np.zeros_like(truth), truth).means()
    assert {name: nothing[name] for name in NAMES} == {name: float(name == "loca") for name in NAMES}
    empty = hota_of(np.zeros_like(truth), np.zeros_like(truth))
    assert all(math.isnan(value) for value in empty.means().values())
    assert HotaCounts.total([empty, hota_of(truth, truth)]).means()["hota"] == 1
    assert math.isnan(HotaCounts.total([]).means()["hota"])


def test_curves_are_shares(make) -> None:
    for found, truth in make.some_videos(5).values():
        for curve in hota_of(found, truth).curves().values():
            assert ((curve >= 0) & (curve <= 1)).all()
