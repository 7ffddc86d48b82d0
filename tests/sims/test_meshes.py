"""Object frames, decimation, hulls and files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from sims import meshes


def _turned_box(angle: float) -> trimesh.Trimesh:
    box = trimesh.creation.box((0.2, 0.06, 0.1))
    box.apply_transform(trimesh.transformations.rotation_matrix(angle, [0, 0, 1]))
    box.apply_translation([0.3, -0.2, 0.05])
    return box


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.2, 2.5])
def test_object_frame_is_upright_centred_and_along_the_longer_side(angle: float) -> None:
    framed = meshes.object_frame(_turned_box(angle))
    np.testing.assert_allclose(framed.extents, [0.2, 0.06, 0.1], atol=0.003)
    np.testing.assert_allclose(framed.bounds.sum(axis=0), 0, atol=1e-9)


def test_decimated_ball_keeps_its_shape() -> None:
    vertices, triangles = meshes.decimate(trimesh.creation.icosphere(subdivisions=5), 300)
    assert 250 <= len(triangles) <= 300
    assert trimesh.Trimesh(vertices, triangles).volume == pytest.approx(4 / 3 * np.pi, rel=0.05)


def test_corner_normals_keep_a_boxs_edges_and_smooth_a_ball() -> None:
    box = trimesh.creation.box((1, 2, 3))
    normals = meshes.corner_normals(np.asarray(box.vertices), np.asarray(box.faces))
    np.testing.assert_allclose(normals, np.repeat(box.face_normals[:, None], 3, axis=1), atol=1e-9)
    ball = trimesh.creation.icosphere(subdivisions=3)
    normals = meshes.corner_normals(np.asarray(ball.vertices), np.asarray(ball.faces))
    np.testing.assert_allclose(normals, ball.vertices[ball.faces], atol=0.05)


def test_hull_is_light_and_nearly_whole() -> None:
    points = np.asarray(trimesh.creation.icosphere(subdivisions=5).vertices)
    hull = meshes.hull_vertices(points)
    assert len(hull) <= 106
    assert trimesh.convex.convex_hull(hull).volume == pytest.approx(4 / 3 * np.pi, rel=0.06)


def test_slices_of_an_arch_leave_its_hollow_free() -> None:
    ring = trimesh.creation.annulus(r_min=0.06, r_max=0.09, height=0.03, sections=96)
    points = np.asarray(ring.subdivide().vertices)
    arch = points[points[:, 1] > 0]
    parts = meshes.convex_parts(arch, "arch", convex=False)
    volume = sum(trimesh.convex.convex_hull(part).volume for part in parts)
    assert len(parts) == 6
    assert volume < 0.75 * trimesh.convex.convex_hull(arch).volume


def test_files_come_back_as_written(tmp_path: Path) -> None:
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    vertices, triangles = np.asarray(box.vertices), np.asarray(box.faces)
    uv = np.random.default_rng(0).random((len(triangles), 3, 2))
    meshes.write_obj(
        tmp_path / "box.obj", vertices, triangles, meshes.corner_normals(vertices, triangles), uv, "box.png"
    )
    read = trimesh.load_mesh(tmp_path / "box.obj", process=False)
    np.testing.assert_allclose(read.extents, [0.1, 0.2, 0.3])
    assert "map_Kd box.png" in (tmp_path / "box.mtl").read_text()
    meshes.write_hulls(tmp_path / "hulls.obj", [vertices, vertices + 1])
    text = (tmp_path / "hulls.obj").read_text()
    assert text.count("\no part") + text.startswith("o part") == 2
    assert trimesh.load_mesh(tmp_path / "hulls.obj").volume == pytest.approx(2 * 0.006)


def test_frame_of_a_tilted_cloud_is_deterministic() -> None:
    mesh = trimesh.creation.capsule(height=0.1, radius=0.03)
    mesh.vertices = Rotation.from_euler("xz", [1.3, 0.7]).apply(mesh.vertices)
    first, second = meshes.object_frame(mesh), meshes.object_frame(mesh)
    assert np.asarray(first.vertices).tobytes() == np.asarray(second.vertices).tobytes()
