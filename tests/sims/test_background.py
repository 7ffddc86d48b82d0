"""The empty scene: exact depth, a table with texture."""

from __future__ import annotations

import numpy as np
import pytest

from sims.background import FLOOR_Z_M, TABLE_HIGH_M, TABLE_LOW_M, WALL_M, background
from sims.camera import Camera


def test_depth_of_the_table_is_where_the_plane_is() -> None:
    camera = Camera()
    empty = background(camera, 32)
    matrix, extrinsics = camera.intrinsics(32), camera.extrinsics()
    for row, column in ((31, 0), (16, 16), (20, 31)):
        # The plane z = 0 in camera coordinates: normal . X = offset.
        normal = extrinsics[:3, 2]
        offset = normal @ (extrinsics[:3, :3] @ np.zeros(3) + extrinsics[:3, 3])
        ray = np.linalg.inv(matrix) @ [column + 0.5, row + 0.5, 1]
        assert empty.table[row, column]
        assert empty.depth[row, column] == pytest.approx(offset / (normal @ ray), rel=1e-9)


def test_points_project_back_to_their_pixels() -> None:
    camera = Camera(eye=(1.6, -1.4, 0.9), target=(0.3, 0.0, 0.0), fov_deg=60.0)
    empty = background(camera, 24)
    pixels, depth = camera.project(empty.points, 24)
    row, column = np.mgrid[0:24, 0:24] + 0.5
    np.testing.assert_allclose(pixels[..., 0], column, atol=1e-9)
    np.testing.assert_allclose(pixels[..., 1], row, atol=1e-9)
    np.testing.assert_allclose(depth, empty.depth)


def test_everything_lies_on_a_surface_of_the_room() -> None:
    camera = Camera(eye=(1.9, 1.7, 1.2), target=(0.0, 0.0, 0.1), fov_deg=80.0)
    empty = background(camera, 48)
    x, y, z = np.moveaxis(empty.points, -1, 0)
    on_top = np.isclose(z, 0)
    assert (on_top[empty.table]).all()
    assert ((x >= TABLE_LOW_M[0] - 1e-9) & (x <= TABLE_HIGH_M[0] + 1e-9))[empty.table].all()
    assert 0.02 < empty.table.mean() < 0.9
    assert (np.isclose(z, FLOOR_Z_M) & ~empty.table).any()
    assert (np.isclose(np.abs(x), WALL_M) | np.isclose(np.abs(y), WALL_M)).any()


def test_the_table_has_grain_and_colours_are_valid() -> None:
    empty = background(Camera(), 64)
    assert empty.rgb.min() >= 0
    assert empty.rgb.max() <= 255
    assert empty.rgb[empty.table].std(axis=0).min() > 2
