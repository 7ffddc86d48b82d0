from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
import torch

from apex_lab.metrics import covering
from apex_lab.metrics.overlap import mean_best_overlap, mean_matched_iou


def test_mbo_is_covering_of_the_foreground(make) -> None:
    for found, truth in make.some_videos(4).values():
        counts = make.counts_of(found, truth)
        tensors = torch.from_numpy(found)[None], torch.from_numpy(truth)[None]
        frames = covering(*tensors, background=False)[0].numpy()
        np.testing.assert_allclose([mean_best_overlap(frame) for frame in counts], frames, rtol=0, atol=1e-12)
        volume = float(covering(*tensors, background=False, mode="sequence"))
        assert mean_best_overlap(counts.sum(axis=0)) == pytest.approx(volume, abs=1e-12)


def brute_force_matched_iou(found: np.ndarray, truth: np.ndarray) -> float:
    objects, segments = [i for i in np.unique(truth) if i > 0], list(np.unique(found))
    segments += [-1 - i for i in range(len(objects))]  # partners that hold no pixel
    best = 0.0
    for chosen in permutations(segments, len(objects)):
        pairs = [(truth == i, found == k) for i, k in zip(objects, chosen, strict=True)]
        best = max(best, sum((a & b).sum() / (a | b).sum() for a, b in pairs))
    return best / len(objects)


@pytest.mark.parametrize("segments", [1, 2, 5])
def test_matched_iou_agrees_with_every_assignment(make, segments: int) -> None:
    truth = np.random.default_rng(segments).integers(0, 4, (3, 5, 6))
    found = make.noisy(truth, 0.5, segments, segments) % segments
    for frame, counts in enumerate(make.counts_of(found, truth)):
        expected = brute_force_matched_iou(found[frame], truth[frame])
        assert mean_matched_iou(counts) == pytest.approx(expected, abs=1e-12)


def test_one_mask_over_two_objects(make) -> None:
    counts = make.counts_of(make.strip([9, 5, 5]), make.strip([0, 1, 2]))[0]
    assert mean_best_overlap(counts) == 0.5
    assert mean_matched_iou(counts) == 0.25


def test_without_objects_there_is_no_value(make) -> None:
    counts = make.counts_of(make.strip([1, 2]), make.strip([0, 0]))[0]
    assert np.isnan(mean_best_overlap(counts))
    assert np.isnan(mean_matched_iou(counts))
