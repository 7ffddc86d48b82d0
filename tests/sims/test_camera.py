"""The camera's own matrices against each other and against points at known positions."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from sims.camera import Camera

CAMERA = Camera(eye=(1.0, -0.4, 0.7), target=(0.4, 0.1, 0.05), fov_deg=40.0, near_m=0.2, far_m=3.0)


def test_target_lies_in_the_middle_at_its_distance() -> None:
    pixel, depth = CAMERA.project(np.array(CAMERA.target), 100)
    np.testing.assert_allclose(pixel, [50, 50], atol=1e-9)
    assert depth == pytest.approx(np.linalg.norm(np.subtract(CAMERA.eye, CAMERA.target)))


def test_up_is_up_and_right_is_right() -> None:
    forward = np.subtract(CAMERA.target, CAMERA.eye)
    right = np.cross(forward, [0, 0, 1])
    above, _ = CAMERA.project(np.array(CAMERA.target) + np.array([0, 0, 0.05]), 100)
    aside, _ = CAMERA.project(np.array(CAMERA.target) + 0.05 * right / np.linalg.norm(right), 100)
    assert above[1] < 50
    assert above[0] == pytest.approx(50)
    assert aside[0] > 50
    assert aside[1] == pytest.approx(50)


def test_field_of_view_reaches_the_border() -> None:
    distance = np.linalg.norm(np.subtract(CAMERA.eye, CAMERA.target))
    rotation = CAMERA.extrinsics()[:3, :3]
    edge = np.array(CAMERA.target) + rotation[1] * distance * np.tan(np.radians(CAMERA.fov_deg / 2))
    pixel, _ = CAMERA.project(edge, 64)
    assert pixel[1] == pytest.approx(64)


def test_opengl_matrices_agree_with_projection() -> None:
    points = np.random.default_rng(0).uniform([0.2, -0.2, 0], [0.6, 0.3, 0.3], size=(20, 3))
    view = np.array(CAMERA.view_matrix()).reshape(4, 4).T
    projection = np.array(CAMERA.projection_matrix()).reshape(4, 4).T
    clip = np.column_stack([points, np.ones(20)]) @ (projection @ view).T
    normalised = clip[:, :3] / clip[:, 3:]
    pixels, depth = CAMERA.project(points, 128)
    np.testing.assert_allclose((normalised[:, 0] + 1) * 64, pixels[:, 0])
    np.testing.assert_allclose((1 - normalised[:, 1]) * 64, pixels[:, 1])
    np.testing.assert_allclose(CAMERA.metres((normalised[:, 2] + 1) / 2), depth)


def test_extrinsics_are_a_rigid_motion() -> None:
    matrix = CAMERA.extrinsics()
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(matrix @ [*CAMERA.eye, 1], [0, 0, 0, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"near_m": 2.0, "far_m": 1.0}, "far_m 1.0 must be greater"),
        ({"eye": (0.5, 0.0, 1.0), "target": (0.5, 0.0, 0.0)}, "vertically above"),
        ({"fov_deg": 0.5}, "fov_deg"),
        ({"zoom": 2.0}, "zoom"),
    ],
)
def test_impossible_cameras_are_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        Camera.model_validate(change)


def test_cameras_compare_and_hash_after_use() -> None:
    one, other = Camera(), Camera()
    one.project(np.zeros(3), 8)
    assert one == other
    assert hash(one) == hash(other)
