"""Level sets and baked textures, against shapes of known size."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sims import meshes, surfaces


def test_level_set_of_a_ball() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(40.0)] * 3, indexing="ij"), axis=-1)
    field = 12.3 - np.linalg.norm(grid - [19.2, 20.1, 18.7], axis=-1)
    vertices, triangles = surfaces.level_set(field, 0.0)
    ball = trimesh.Trimesh(vertices, triangles, process=False)
    assert ball.is_watertight
    assert ball.volume == pytest.approx(4 / 3 * np.pi * 12.3**3, rel=0.01)  # positive: triangles face outwards
    assert np.linalg.norm(vertices - [19.2, 20.1, 18.7], axis=1) == pytest.approx(12.3, abs=0.2)


def test_outer_surface_closes_an_open_box_and_drops_what_is_inside() -> None:
    box = trimesh.creation.box((0.2, 0.1, 0.06))
    keep = box.face_normals[:, 2] < 0.9
    shell = trimesh.Trimesh(box.vertices, box.faces[keep], process=False)
    inner = trimesh.creation.box((0.05, 0.05, 0.02))
    whole = trimesh.Trimesh(
        np.concatenate([shell.vertices, inner.vertices]),
        np.concatenate([shell.faces, inner.faces + len(shell.vertices)]),
        process=False,
    )
    outer = surfaces.outer_surface(whole, cells=80)
    assert outer.is_watertight
    assert outer.body_count == 1
    np.testing.assert_allclose(outer.extents, [0.2, 0.1, 0.06], atol=0.005)
    assert outer.volume == pytest.approx(0.2 * 0.1 * 0.06, rel=0.08)


def test_baked_colours_are_those_of_the_surface() -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    points = trimesh.creation.icosphere(subdivisions=5, radius=1.0).vertices
    colours = np.where(points[:, 2:] > 0, [250, 10, 10], [10, 10, 250]).astype(np.uint8)
    picture, uv = surfaces.bake(ball.vertices, ball.faces, np.asarray(points), colours, 12)
    assert uv.min() > 0
    assert uv.max() < 1
    rng = np.random.default_rng(0)
    for face, corners in enumerate(ball.faces):
        weights = rng.dirichlet([1, 1, 1])
        height = (weights @ ball.vertices[corners])[2]
        u, v = weights @ uv[face]
        row, column = int((1 - v) * picture.shape[0]), int(u * picture.shape[1])
        if abs(height) > 0.06:  # about a texel from the border between the colours
            assert picture[row, column].tolist() == ([250, 10, 10] if height > 0 else [10, 10, 250])


def test_transferred_normals_of_a_ball_point_outwards() -> None:
    fine = trimesh.creation.icosphere(subdivisions=4)
    vertices, triangles = meshes.decimate(fine, 120)
    normals = surfaces.transferred_normals(vertices, triangles, fine)
    outward = vertices[triangles] / np.linalg.norm(vertices[triangles], axis=-1, keepdims=True)
    assert (normals * outward).sum(axis=-1).min() > 0.98
