"""Convex hulls of masks against OpenCV's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from apex_lab.models.apex.hulls import hollow
from tests.models.apex.hull import hull_count, in_tangents


def blobs(seed: int, count: int = 8, size: int = 40) -> Tensor:
    """Masks of two or three ellipses each, (count, size, size)."""
    random = np.random.default_rng(seed)
    masks = np.zeros((count, size, size), np.uint8)
    for mask in masks:
        for _ in range(random.integers(2, 4)):
            centre, axes = random.integers(8, size - 8, 2).tolist(), random.integers(2, 8, 2).tolist()
            cv2.ellipse(mask, centre, axes, float(random.uniform(0, 180)), 0, 360, 1, -1)
    return torch.from_numpy(masks).bool()


@pytest.mark.parametrize("seed", range(4))
def test_the_polygon_is_the_hull_or_larger_by_less_than_a_pixel(seed: int) -> None:
    masks = blobs(seed)
    for mask, found in zip(masks, hollow(masks, ~masks).tolist(), strict=True):
        assert found == in_tangents(mask, ~mask)
        assert hull_count(mask, ~mask) <= found <= hull_count(mask, ~mask, reach=0.7)


def test_upright_boxes_and_diamonds_are_their_own_hulls() -> None:
    masks = torch.zeros(3, 20, 20, dtype=torch.bool)
    masks[0, 3:9, 5:17] = True
    y, x = torch.meshgrid(torch.arange(20), torch.arange(20), indexing="ij")
    masks[1] = (y - 9).abs() + (x - 10).abs() <= 6
    masks[2, 0, 19] = True
    everything = torch.ones_like(masks)
    assert hollow(masks, everything).tolist() == [72.0, 85.0, 1.0]
    assert hollow(masks, ~masks).tolist() == [0.0, 0.0, 0.0]


def test_only_counted_pixels_count() -> None:
    mask = torch.zeros(1, 10, 10, dtype=torch.bool)
    mask[0, 2:8, 1] = mask[0, 2:8, 8] = True  # two bars, six pixels apart
    assert hollow(mask, ~mask).tolist() == [36.0]
    half = ~mask
    half[0, :5] = False
    assert hollow(mask, half).tolist() == [18.0]


def test_an_empty_mask_has_no_hull() -> None:
    nothing = torch.zeros(2, 8, 8, dtype=torch.bool)
    assert hollow(nothing, ~nothing).tolist() == [0.0, 0.0]
