from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from apex_lab.metrics.boundary import assign_tracks, boundary, boundary_measure, boundary_scores, tolerance_px
from apex_lab.metrics.contingency import contingency


def brute_force_boundary(mask: np.ndarray) -> np.ndarray:
    height, width = mask.shape
    edge = np.zeros_like(mask)
    for y in range(height):
        for x in range(width):
            near = [(y, x + 1), (y + 1, x), (y + 1, x + 1)]
            edge[y, x] = any(mask[y, x] != mask[b, a] for b, a in near if b < height and a < width)
    return edge


def brute_force_f(found: np.ndarray, true: np.ndarray, radius: int) -> float:
    """By distances from each boundary pixel to the nearest of the other mask."""
    edges = brute_force_boundary(found), brute_force_boundary(true)
    if not (edges[0].any() or edges[1].any()):
        return 1.0
    if not (edges[0].any() and edges[1].any()):
        return 0.0
    precision = (distance_transform_edt(~edges[1])[edges[0]] <= radius).mean()
    recall = (distance_transform_edt(~edges[0])[edges[1]] <= radius).mean()
    return 0.0 if precision + recall == 0 else 2 * precision * recall / (precision + recall)


@pytest.mark.parametrize("radius", [1, 2, 3])
def test_f_agrees_with_distances(radius: int) -> None:
    rng = np.random.default_rng(radius)
    masks = rng.random((2, 12, 9, 9)).repeat(2, axis=2).repeat(2, axis=3) < 0.15
    masks[0, 0] = masks[1, 1] = False
    masks[:, 2] = False
    masks[:, 3] = True
    expected = [brute_force_f(found, true, radius) for found, true in zip(*masks, strict=True)]
    np.testing.assert_allclose(boundary_measure(*masks, radius), expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(boundary(masks[0]), [brute_force_boundary(mask) for mask in masks[0]])


def test_a_shift_within_the_tolerance_costs_nothing() -> None:
    masks = np.zeros((1, 40, 40), dtype=bool)
    masks[:, 10:20, 10:20] = True
    assert boundary_measure(np.roll(masks, 1, axis=2), masks, radius=1) == 1
    assert boundary_measure(np.roll(masks, 2, axis=2), masks, radius=1) < 1


def test_tolerance_in_pixels() -> None:
    assert tolerance_px((128, 128)) == 2  # 0.008 * 181 = 1.45
    assert tolerance_px((480, 854)) == 8  # DAVIS
    assert tolerance_px((32, 32)) == 1


def test_tracks_are_assigned_by_their_mean_j(make) -> None:
    truth = make.strip([0, 1, 2], [0, 1, 2], [0, 1, 2])
    found = make.strip([9, 4, 5], [9, 4, 5], [9, 5, 4])
    j, partner = assign_tracks(make.counts_of(found, truth))
    assert partner.tolist() == [0, 1]
    assert j.tolist() == [[1, 1, 0], [1, 1, 0]]


def test_an_object_without_partner_is_compared_with_an_empty_mask(make) -> None:
    truth, found = make.strip([0, 1, 2], [0, 1, 0]), make.strip([4, 4, 4], [4, 4, 4])
    j, partner = assign_tracks(make.counts_of(found, truth))
    assert sorted(partner.tolist()) == [0, 1]
    # Object 1 takes the one segment; object 2 is right about its absence once.
    assert j.tolist() == [[1 / 3, 1 / 3], [0.0, 1.0]]


def test_scores_of_a_perfect_video(make) -> None:
    _, truth = make.some_videos(3)["v2"]
    table = contingency(torch.from_numpy(truth)[None], torch.from_numpy(truth)[None])
    arrays = table.counts[0].numpy(), table.labels[0].numpy(), table.ids[0].numpy()
    scores = boundary_scores(truth, truth, *arrays)
    assert scores.j.shape == scores.f.shape == (len(arrays[1]) - 1, len(truth))
    assert (scores.j == 1).all()
    assert (scores.f == 1).all()
