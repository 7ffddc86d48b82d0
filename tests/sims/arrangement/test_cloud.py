"""Bodies from masks and depth, against made scenes whose boxes are known."""

from __future__ import annotations

import numpy as np
import pytest

from sims.arrangement import cloud
from sims.arrangement.grasps import WIDEST_M, grasps, releases
from sims.arrangement.sensor import stereo
from sims.arrangement.settings import Settings
from sims.arrangement.types import View
from sims.background import background

CAMERA = Settings().camera
SIZE = 128
LOW, HIGH = np.array([0.2, -0.4]), np.array([0.8, 0.4])


def _scene(*boxes: tuple[float, float, float, float, float, float]) -> tuple[View, list[np.ndarray]]:
    """Depth and masks of boxes (x, y, long, narrow, yaw, height), by casting a ray per pixel."""
    empty = background(CAMERA, SIZE)
    eye = np.asarray(CAMERA.eye)
    rays = (empty.points - eye) / empty.depth[..., None]
    depth, ids = empty.depth.copy(), np.zeros(empty.depth.shape, dtype=int)
    for number, (x, y, long, narrow, yaw, height) in enumerate(boxes, start=1):
        turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        start, way = turn @ (eye - [x, y, height / 2]), rays @ turn.T
        half = np.array([long, narrow, height]) / 2
        one, two = (-half - start) / way, (half - start) / way
        enter, leave = np.minimum(one, two).max(axis=-1), np.maximum(one, two).min(axis=-1)
        hit = (enter <= leave) & (enter < depth)
        depth[hit], ids[hit] = enter[hit], number
    view = View(np.zeros((SIZE, SIZE, 3), np.uint8), depth.astype(np.float32), CAMERA)
    return view, [ids == number for number in range(1, len(boxes) + 1)]


def _body(view: View, mask: np.ndarray) -> cloud.Body:
    body = cloud.body_of(view, cloud.points_of(view), mask)
    assert body is not None
    return body


@pytest.mark.parametrize("yaw", [0.0, 0.5, 1.2, 2.0, 2.9])
def test_place_footprint_and_height_of_a_box(yaw: float) -> None:
    view, (mask,) = _scene((0.45, 0.03, 0.12, 0.05, yaw, 0.08))
    body = _body(view, mask)
    np.testing.assert_allclose(body.centre, [0.45, 0.03], atol=0.004)
    np.testing.assert_allclose(body.sides, [0.12, 0.05], atol=0.008)
    assert body.height == pytest.approx(0.08, abs=0.004)
    assert abs(np.sin(body.yaw - yaw)) < 0.1
    grasp = grasps(body)[0]
    assert abs(np.sin(grasp.yaw - yaw)) < 0.1
    assert grasp.width == pytest.approx(0.05, abs=0.008)
    np.testing.assert_allclose(grasp.point[:2], body.centre, atol=0.004)


def test_a_sloppy_mask_does_not_move_the_body() -> None:
    """Table pixels around the object, and a far speck, are no part of it."""
    view, (mask,) = _scene((0.45, 0.0, 0.1, 0.06, 0.4, 0.08))
    exact = _body(view, mask)
    rows, columns = np.nonzero(mask)
    mask[rows.min() - 4 : rows.max() + 5, columns.min() - 4 : columns.max() + 5] = True
    mask[5:8, 5:8] = True
    np.testing.assert_allclose(_body(view, mask).centre, exact.centre, atol=1e-6)


def test_a_mask_over_two_objects_gives_the_larger() -> None:
    view, masks = _scene((0.4, -0.1, 0.12, 0.06, 0.0, 0.09), (0.52, 0.12, 0.06, 0.05, 0.3, 0.05))
    np.testing.assert_allclose(_body(view, masks[0] | masks[1]).centre, [0.4, -0.1], atol=0.004)


def test_no_body_without_points() -> None:
    view, (mask,) = _scene((0.45, 0.0, 0.1, 0.06, 0.4, 0.08))
    points = cloud.points_of(view)
    assert cloud.body_of(view, points, np.zeros_like(mask)) is None
    assert cloud.body_of(view, points, ~mask) is None
    for empty in (0.0, np.nan, np.inf):
        holes = View(view.rgb, np.full_like(view.depth, empty), CAMERA)
        assert cloud.body_of(holes, cloud.points_of(holes), mask) is None


def test_bodies_without_a_mask_are_strangers() -> None:
    view, masks = _scene((0.4, -0.1, 0.12, 0.06, 0.0, 0.09), (0.52, 0.12, 0.06, 0.05, 0.3, 0.05))
    points = cloud.points_of(view)
    (found,) = cloud.strangers(view, points, masks[:1], LOW, HIGH)
    np.testing.assert_allclose(found.centre, [0.52, 0.12], atol=0.006)
    assert cloud.strangers(view, points, masks, LOW, HIGH) == []
    assert cloud.strangers(view, points, masks[:1], LOW, np.array([0.45, 0.4])) == []


def test_outliers_are_removed() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 0.05, (300, 3))
    wild = np.array([[0.3, 0.3, 0.3], [-0.2, 0.1, 0.0]])
    left = cloud.without_outliers(np.concatenate([points, wild]))
    assert len(left) > 280
    assert left.max() <= 0.05


def test_a_large_image_gives_the_same_body_from_thinned_points() -> None:
    view, (mask,) = _scene((0.45, 0.03, 0.12, 0.05, 0.7, 0.08))
    fine = View(view.rgb, np.kron(view.depth, np.ones((6, 6), np.float32)), CAMERA)
    body = _body(fine, np.kron(mask, np.ones((6, 6), bool)))
    assert len(body.points) < 3000
    np.testing.assert_allclose(body.centre, [0.45, 0.03], atol=0.006)


def test_a_body_wider_than_the_gripper_has_no_grasp() -> None:
    view, (mask,) = _scene((0.45, 0.0, 0.14, 0.1, 0.4, 0.08))
    assert grasps(_body(view, mask)) == []
    assert WIDEST_M < 0.08


def test_released_bodies_lie_as_their_targets() -> None:
    view, masks = _scene((0.4, -0.1, 0.12, 0.05, 0.2, 0.08), (0.52, 0.12, 0.12, 0.05, 1.1, 0.08))
    body, target = (_body(view, mask) for mask in masks)
    grasp = grasps(body)[0]
    first = releases(body, grasp, target)[0]
    assert abs(np.sin(first.yaw - grasp.yaw - (target.yaw - body.yaw))) < 1e-9
    np.testing.assert_allclose(first.point[:2], target.centre, atol=0.004)


def test_stereo_depth_is_a_function_of_the_image_with_noise_and_holes() -> None:
    view, (mask,) = _scene((0.45, 0.0, 0.12, 0.06, 0.4, 0.08))
    noisy = stereo(view.depth)
    np.testing.assert_array_equal(noisy, stereo(view.depth))
    lost = noisy == 0
    assert 0.01 < lost.mean() < 0.2
    error = (noisy - view.depth)[~lost & (view.depth < 1.2)]
    assert 0.001 < error.std() < 0.006
    body = _body(View(view.rgb, noisy, CAMERA), mask)
    np.testing.assert_allclose(body.centre, [0.45, 0.0], atol=0.015)
