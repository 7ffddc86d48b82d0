"""Procedural textures and their coordinates on the scans."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh

from sims import drawings, textures
from sims.objects import CATALOGUE

NAMES = [entry.name for entry in CATALOGUE]


@pytest.fixture(scope="module")
def pictures() -> dict[str, np.ndarray]:
    return {name: np.asarray(drawings.draw(name, 64), dtype=np.float64) for name in NAMES}


def test_there_are_fourteen_classes_with_distinct_names() -> None:
    assert len(set(NAMES)) == len(CATALOGUE) == 14
    assert sorted(drawings.DRAWINGS) == sorted(NAMES)
    assert len({entry.ycb for entry in CATALOGUE}) == 14


@pytest.mark.parametrize("name", NAMES)
def test_no_texture_is_flat(name: str, pictures: dict[str, np.ndarray]) -> None:
    spread = pictures[name].reshape(-1, 3).std(axis=0).max()
    assert spread > 10
    assert len(np.unique(pictures[name].reshape(-1, 3) // 32, axis=0)) >= 4


def test_no_two_textures_are_alike(pictures: dict[str, np.ndarray]) -> None:
    """By colours alone, regardless of position: the distance between histograms is large for every pair."""
    histograms = {}
    for name, picture in pictures.items():
        counts, _ = np.histogramdd(picture.reshape(-1, 3), bins=(6, 6, 6), range=[(0, 256)] * 3)
        histograms[name] = counts.ravel() / counts.sum()
    for one, other in itertools.combinations(NAMES, 2):
        assert np.abs(histograms[one] - histograms[other]).sum() / 2 > 0.3, (one, other)


def test_drawing_is_deterministic() -> None:
    assert drawings.draw("banana", 64).tobytes() == drawings.draw("banana", 64).tobytes()
    assert drawings.draw("mug", 128).size == (192, 128)


def test_box_lays_each_side_into_its_own_tile() -> None:
    box = trimesh.creation.box((0.2, 0.1, 0.3))
    uv = textures.texture_coordinates(np.asarray(box.vertices), np.asarray(box.faces), "box")
    middle = uv.mean(axis=1)
    tile = np.floor(middle[:, 0] * 3) + 3 * (middle[:, 1] < 0.5)
    expected = {(0, -1, 0): 0, (0, 1, 0): 1, (0, 0, 1): 2, (1, 0, 0): 3, (-1, 0, 0): 4, (0, 0, -1): 5}
    for normal, number in zip(np.rint(box.face_normals).astype(int), tile, strict=True):
        assert expected[tuple(normal.tolist())] == number


def test_lettering_on_the_front_reads_from_left_to_right_and_stands_upright() -> None:
    """Seen from -y, the picture's u grows to the right (+x) and its v upwards (+z)."""
    for shape, projection in (
        (trimesh.creation.box((0.2, 0.1, 0.3)), "box"),
        (trimesh.creation.cylinder(0.05, 0.2, sections=48), "can"),
    ):
        vertices, triangles = np.asarray(shape.vertices), np.asarray(shape.faces)
        uv = textures.texture_coordinates(vertices, triangles, projection)  # type: ignore[arg-type]
        front = shape.face_normals[:, 1] < -0.9
        corners = vertices[triangles[front]].reshape(-1, 3)
        for axis, coordinate in ((0, 0), (2, 1)):
            assert np.corrcoef(corners[:, axis], uv[front].reshape(-1, 2)[:, coordinate])[0, 1] > 0.95


def test_no_triangle_crosses_the_strips_seam() -> None:
    can = trimesh.creation.cylinder(0.05, 0.2, sections=40)
    uv = textures.texture_coordinates(np.asarray(can.vertices), np.asarray(can.faces), "can")
    assert np.ptp(uv[np.abs(can.face_normals[:, 2]) < 0.5][..., 0], axis=1).max() < 0.05
    assert uv.min() >= 0
    assert uv.max() <= 1
