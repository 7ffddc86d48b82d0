"""The objects' models: sizes, resting orientations, textures, and folders of textured models."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from sims import official
from sims.assets import object_models
from sims.errors import SimError
from sims.objects import CATALOGUE
from sims.p2d.settings import Settings
from sims.scans import scan_file

pytest.importorskip("pybullet")

NAMES = tuple(entry.name for entry in CATALOGUE)
# A sample of the official textured models, where a machine has one: a folder with YcbBanana and YcbScissors.
OFFICIAL = os.environ.get("APEX_LAB_YCB_TEXTURED", "")


def test_models_have_the_scans_size_with_few_faces() -> None:
    for entry, model in zip(CATALOGUE, object_models(NAMES), strict=True):
        scan = trimesh.load_mesh(scan_file(entry))
        drawn = trimesh.load_mesh(model.visual)
        assert len(drawn.faces) <= 0.05 * len(scan.faces)
        assert np.ptp(model.vertices, axis=0)[2] == pytest.approx(scan.extents[2], rel=0.05)
        touching = trimesh.convex.convex_hull(model.touching)
        assert touching.volume == pytest.approx(scan.convex_hull.volume, rel=0.1)


def test_rests_are_stable() -> None:
    """The centre of mass stands over the hull's face that touches the table, and the rest is near the nominal one."""
    for entry, model in zip(CATALOGUE, object_models(NAMES), strict=True):
        assert [name for name, _ in model.rests] == [name for name, _, _ in entry.rests]
        for _, quaternion in model.rests:
            turned = Rotation.from_quat(quaternion).apply(model.touching)
            foot = turned[turned[:, 2] < turned[:, 2].min() + 2e-4][:, :2]
            assert len(foot) >= 3, entry.name
            around = trimesh.convex.hull_points(np.concatenate([foot, [[0.0, 0.0]]]))
            assert not (np.abs(around) < 1e-12).all(axis=1).any(), entry.name


def test_unknown_class_is_named_with_the_choices() -> None:
    with pytest.raises(SimError, match=r"'teapot'.*choose from master_chef_can"):
        object_models(("banana", "teapot"))


def _textured_box(folder: Path, size: tuple[float, float, float], *, material: bool = True) -> None:
    """A box whose upper half is red and whose lower half is blue, as an OBJ with texture coordinates."""
    folder.mkdir(parents=True)
    box = trimesh.creation.box(size)
    lines = ["mtllib box.mtl"] if material else []
    corners = box.vertices[box.faces].reshape(-1, 3)
    lines += [f"v {x} {y} {z}" for x, y, z in corners]
    lines += [f"vt 0.5 {0.9 if z > 0 else 0.1}" for _, _, z in corners]
    lines += ["usemtl painted"] if material else []
    lines += [f"f {i}/{i} {i + 1}/{i + 1} {i + 2}/{i + 2}" for i in range(1, len(corners), 3)]
    (folder / "textured.obj").write_text("\n".join(lines) + "\n")
    if material:
        (folder / "box.mtl").write_text("newmtl painted\nmap_Kd paint.png\n")
    picture = np.zeros((16, 16, 3), dtype=np.uint8)
    picture[:8], picture[8:] = (200, 20, 20), (20, 20, 200)
    Image.fromarray(picture).save(folder / "paint.png")


@pytest.mark.parametrize("material", [True, False])
def test_textured_models_are_read_from_a_folder(tmp_path: Path, material: bool) -> None:
    _textured_box(tmp_path / "YcbSugarBox", (0.09, 0.04, 0.17), material=material)
    _textured_box(tmp_path / "brick", (0.05, 0.05, 0.08), material=material)
    sugar, brick = object_models(("sugar_box", "brick"), str(tmp_path))
    assert sugar.mass_kg == 0.514
    assert sum(trimesh.convex.convex_hull(part).volume for part in brick.parts) == pytest.approx(2e-4, rel=0.2)
    assert brick.mass_kg == pytest.approx(0.05 * 0.05 * 0.08 * 300, rel=0.01)
    np.testing.assert_allclose(np.ptp(sugar.vertices, axis=0), [0.09, 0.04, 0.17], atol=1e-4)
    drawn = trimesh.load_mesh(sugar.visual, process=False)
    picture = np.asarray(Image.open(sugar.visual.parent / "texture.png"))
    for corner, (u, v) in zip(drawn.vertices, drawn.visual.uv, strict=True):
        colour = picture[int((1 - v) * picture.shape[0]), int(u * picture.shape[1])]
        assert (colour[0] > colour[2]) == (corner[2] > 0)


def test_missing_things_are_named(tmp_path: Path) -> None:
    with pytest.raises(SimError, match="is not a folder"):
        object_models(("banana",), str(tmp_path / "nowhere"))
    _textured_box(tmp_path / "YcbBanana", (0.1, 0.03, 0.03))
    with pytest.raises(SimError, match=r"no sub-folder for object 'mug' \(it has YcbBanana\)"):
        object_models(("banana", "mug"), str(tmp_path))
    (tmp_path / "YcbMug").mkdir()
    with pytest.raises(SimError, match="no OBJ file with texture coordinates"):
        object_models(("mug",), str(tmp_path))
    (tmp_path / "YcbBanana" / "paint.png").unlink()
    with pytest.raises(SimError, match=r"paint\.png.*missing"):
        object_models(("banana",), str(tmp_path))


@pytest.mark.parametrize("name", ["011_banana", "YcbBanana", "banana", "Banana"])
def test_names_are_found_with_and_without_prefixes(name: str) -> None:
    assert official.plain_name(name) == "banana"


@pytest.mark.skipif(not OFFICIAL, reason="APEX_LAB_YCB_TEXTURED names no folder with official textured models")
def test_official_samples() -> None:
    banana, scissors = object_models(("011_banana", "YcbScissors"), OFFICIAL)
    np.testing.assert_allclose(np.ptp(banana.vertices, axis=0)[2], 0.0375, atol=0.002)
    assert np.ptp(scissors.vertices, axis=0).max() == pytest.approx(0.2, abs=0.02)
    colours = np.asarray(Image.open(banana.visual.parent / "texture.png")).reshape(-1, 3)
    painted = colours[colours.sum(axis=1) > 0].mean(axis=0)
    assert painted[0] > 1.5 * painted[2]  # yellow
    Settings(objects=("011_banana", "YcbScissors"), max_objects=2, objects_root=OFFICIAL)
