"""Labels against their image and against geometry rendered independently."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

pytest.importorskip("pybullet")

from sims import arm as panda
from sims import meshes, outlines
from sims.assets import ObjectModel, object_models
from sims.background import background
from sims.bullet import Client
from sims.camera import Camera
from sims.errors import SimError
from sims.objects import CATALOGUE
from sims.poses import moved
from sims.render import ARM_ID, FIRST_OBJECT_ID, Renderer
from sims.stage import Stage, load_egl
from sims.world import World

SIZE = 96
NAMES = ("master_chef_can", "banana", "cracker_box")
FAR_AWAY = np.array([0.0, -1.2, 0.0, -2.0, 0.0, 1.0, 0.8, 0.0, 0.0])
"""Joints that fold the arm out of the image."""


def _standing(model: ObjectModel, x: float, y: float, yaw: float) -> np.ndarray:
    quaternion = (Rotation.from_euler("z", yaw) * Rotation.from_quat(model.rests[0][1])).as_quat()
    turned = Rotation.from_quat(quaternion).apply(model.touching)
    return np.array([x, y, -turned[:, 2].min(), *quaternion])


@pytest.fixture(scope="module")
def joints() -> np.ndarray:
    """Of the arm with its gripper over the table, before the objects."""
    world = World()
    world.rebuild()
    arm = world.add_arm()
    angles, _ = panda.joint_path(world.bullet, arm, np.array([[0.5, -0.12, 0.02], [0.52, -0.12, 0.02]]), 0.2)
    world.bullet.close()
    return np.array([*angles[0], 0.0, 0.0])


@pytest.fixture(scope="module")
def models() -> tuple[ObjectModel, ...]:
    return object_models(NAMES)


@pytest.fixture(scope="module")
def poses(models: tuple[ObjectModel, ...]) -> np.ndarray:
    """A can half occluded by the arm, a banana partly in front of the can, a box aside."""
    places = ((0.52, 0.02, 0.3), (0.6, -0.08, 1.0), (0.42, 0.12, -0.4))
    return np.array([_standing(model, *place) for model, place in zip(models, places, strict=True)])


@pytest.fixture(scope="module")
def renderer(models: tuple[ObjectModel, ...]) -> Iterator[Renderer]:
    renderer = Renderer(Camera(), SIZE)
    renderer.show(models)
    yield renderer
    renderer.close()


def test_layers_give_the_same_pixels_as_one_draw(
    renderer: Renderer, models: tuple[ObjectModel, ...], poses: np.ndarray, joints: np.ndarray
) -> None:
    """Colour, ids and depth of everything that is not background, to the bit."""
    picture = renderer.picture(joints, poses)
    stage = Stage("tiny", panda.arm_model())
    stage.show(models)
    stage.pose_joints(joints)
    for body, pose in zip(stage.bodies, poses, strict=True):
        stage.pose(body, pose)
    rgb, depth, ids = stage.draw(renderer.camera, SIZE)
    stage.close()
    front = depth < background(renderer.camera, SIZE).depth
    np.testing.assert_array_equal(picture.segmentation, np.where(front, ids, 0))
    shown = picture.segmentation > 0
    np.testing.assert_array_equal(picture.rgb[shown], rgb[shown])
    np.testing.assert_array_equal(picture.depth[shown], depth[shown].astype(np.float32))
    assert set(np.unique(picture.segmentation)) == {0, 1, 2, 3, 4}


def test_amodal_counts_are_what_each_body_covers_alone(
    renderer: Renderer, models: tuple[ObjectModel, ...], poses: np.ndarray, joints: np.ndarray
) -> None:
    picture = renderer.picture(joints, poses)
    visible = [np.count_nonzero(picture.segmentation == part + 1) for part in range(4)]
    alone = Renderer(renderer.camera, SIZE)
    alone.show(())
    expected = [np.count_nonzero(alone.picture(joints, np.zeros((0, 7))).segmentation)]
    for model, pose in zip(models, poses, strict=True):
        alone.show((model,))
        segmentation = alone.picture(FAR_AWAY, pose[None]).segmentation
        expected.append(np.count_nonzero(segmentation == FIRST_OBJECT_ID))
    alone.close()
    assert picture.amodal_px.tolist() == expected
    assert picture.amodal_px[1] > visible[1]
    assert all(whole >= part for whole, part in zip(picture.amodal_px, visible, strict=True))


def test_silhouettes_agree_with_projected_meshes(renderer: Renderer, poses: np.ndarray) -> None:
    """The stored pose and the scan, projected and filled by OpenCV, overlap the mask by more than 0.95."""
    models = object_models(NAMES)
    for model, pose in zip(models, poses, strict=True):
        renderer.show((model,))
        mask = renderer.picture(FAR_AWAY, pose[None]).segmentation == FIRST_OBJECT_ID
        mesh = trimesh.load_mesh(model.visual)
        # Filled at eight times the resolution and read at pixel centres: OpenCV fills every pixel that it touches.
        pixels, _ = renderer.camera.project(moved(np.asarray(mesh.vertices), pose), 8 * SIZE)
        fine = np.zeros((8 * SIZE, 8 * SIZE), dtype=np.uint8)
        for triangle in np.rint((pixels[mesh.faces] - 0.5) * 16).astype(np.int32):
            cv2.fillConvexPoly(fine, triangle, 1, shift=4)
        filled = fine[4::8, 4::8]
        union, both = np.count_nonzero(mask | (filled > 0)), np.count_nonzero(mask & (filled > 0))
        assert both / union > 0.95, (model.name, both / union)
    renderer.show(models)


def test_depth_of_a_box_of_known_size(renderer: Renderer, tmp_path: Path) -> None:
    """Each pixel of a cube shows the depth at which its ray meets the cube, to a millimetre."""
    side = 0.1
    box = trimesh.creation.box((side, side, side))
    vertices, triangles = np.asarray(box.vertices), np.asarray(box.faces)
    normals = meshes.corner_normals(vertices, triangles)
    meshes.write_obj(tmp_path / "cube.obj", vertices, triangles, normals, np.full((12, 3, 2), 0.5), "cube.png")
    Image.new("RGB", (4, 4), (200, 60, 60)).save(tmp_path / "cube.png")
    cube = replace(
        object_models(("foam_brick",))[0], visual=tmp_path / "cube.obj", vertices=vertices, parts=(vertices,)
    )
    renderer.show((cube,))
    pose = np.array([0.52, 0.0, side / 2, 0, 0, 0, 1.0])
    picture = renderer.picture(FAR_AWAY, pose[None])
    camera = renderer.camera
    mask = picture.segmentation == FIRST_OBJECT_ID
    assert mask.sum() > 200
    inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    rows, columns = np.nonzero(inner)
    rays = np.column_stack([columns + 0.5, rows + 0.5, np.ones(len(rows))]) @ np.linalg.inv(camera.intrinsics(SIZE)).T
    directions, origin = rays @ camera.extrinsics()[:3, :3], np.array(camera.eye)
    with np.errstate(divide="ignore"):
        one, two = (pose[:3] - side / 2 - origin) / directions, (pose[:3] + side / 2 - origin) / directions
    expected = np.minimum(one, two).max(axis=1)
    np.testing.assert_allclose(picture.depth[inner], expected, atol=1e-3)
    assert np.count_nonzero(picture.segmentation == ARM_ID) == 0
    renderer.show(object_models(NAMES))


def test_tiny_renderer_and_ray_caster_agree_on_the_table() -> None:
    """The table top rendered by PyBullet has the depth of the ray-cast background."""
    camera = Camera()
    stage = Stage("tiny", None)
    bullet = stage.bullet
    shape = bullet.call("createVisualShape", bullet.module.GEOM_BOX, halfExtents=[0.8, 0.75, 0.02])
    stage.bodies = [bullet.call("createMultiBody", 0.0, -1, shape, [0.45, 0.15, -0.02])]
    _, drawn, ids = stage.draw(camera, SIZE)
    stage.close()
    empty = background(camera, SIZE)
    assert empty.table.mean() > 0.9
    assert (ids[empty.table] == FIRST_OBJECT_ID).all()
    np.testing.assert_allclose(drawn[empty.table], empty.depth[empty.table], atol=1e-3)


def test_shadows_lie_on_the_table_away_from_the_light() -> None:
    camera = Camera()
    body = trimesh.creation.box((0.06, 0.06, 0.06)).vertices + np.array([0.52, 0.0, 0.03])
    light = np.array([1.0, 0.0, 1.0])
    dark = outlines.shadows(camera, 128, [np.asarray(body)], light) / 255.0
    points = background(camera, 128).points
    middle = (points[..., :2] * dark[..., None]).sum(axis=(0, 1)) / dark.sum()
    # The shadow reaches from the cube's lit foot (x = 0.55) to its top edge's shadow (x = 0.49 - 0.06).
    assert middle[0] == pytest.approx((0.55 + 0.43) / 2, abs=0.01)
    assert middle[1] == pytest.approx(0.0, abs=0.01)
    assert dark.max() > 0.95


def test_shadows_change_only_the_background(renderer: Renderer, joints: np.ndarray, poses: np.ndarray) -> None:
    picture = renderer.picture(joints, poses)
    empty = np.rint(background(renderer.camera, SIZE).rgb).astype(int)
    shown = picture.segmentation == 0
    difference = picture.rgb.astype(int) - empty
    assert difference[shown].max() <= 0
    assert (difference[shown] < -5).any()
    assert (difference[shown] == 0).all(axis=-1).any()


def test_cover_contains_the_silhouette(renderer: Renderer, poses: np.ndarray) -> None:
    picture = renderer.picture(FAR_AWAY, poses)
    for number, (model, pose) in enumerate(zip(object_models(NAMES), poses, strict=True)):
        reach, far = outlines.cover(renderer.camera, SIZE, moved(model.vertices, pose))
        mine = picture.segmentation == FIRST_OBJECT_ID + number
        assert reach[mine].all()
        assert picture.depth[mine].max() <= far + 1e-4


def test_no_two_objects_look_alike_in_the_image() -> None:
    renderer = Renderer(Camera(), 64)
    colours = {}
    for model in object_models(tuple(entry.name for entry in CATALOGUE), None, 64):
        renderer.show((model,))
        picture = renderer.picture(FAR_AWAY, _standing(model, 0.52, 0.0, 0.6)[None])
        seen = picture.rgb[picture.segmentation == FIRST_OBJECT_ID].astype(float)
        assert len(seen) > 25
        assert seen.std(axis=0).max() > 10, model.name
        counts, _ = np.histogramdd(seen, bins=(5, 5, 5), range=[(0, 256)] * 3)
        colours[model.name] = counts / counts.sum()
        table = picture.rgb[picture.segmentation == 0].astype(float).mean(axis=0)
        assert (np.abs(seen - table).max(axis=1) > 30).mean() > 0.7, model.name
    renderer.close()
    names = list(colours)
    for i, one in enumerate(names):
        for other in names[i + 1 :]:
            assert np.abs(colours[one] - colours[other]).sum() / 2 > 0.25, (one, other)


def test_egl_draws_the_same_scene_where_it_can(
    renderer: Renderer, models: tuple[ObjectModel, ...], joints: np.ndarray, poses: np.ndarray
) -> None:
    probe = Client()
    try:
        load_egl(probe)
    except SimError as error:
        pytest.skip(str(error))
    finally:
        probe.close()
    egl = Renderer(renderer.camera, SIZE, "egl")
    egl.show(models)
    one, other = renderer.picture(joints, poses), egl.picture(joints, poses)
    egl.close()
    assert (one.segmentation == other.segmentation).mean() > 0.97
    same = one.segmentation == other.segmentation
    assert np.median(np.abs(one.depth[same] - other.depth[same])) < 2e-3
    np.testing.assert_allclose(other.amodal_px, one.amodal_px, rtol=0.08)
    assert np.abs(one.rgb[same].astype(float) - other.rgb[same]).mean() < 15


def test_a_missing_egl_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(SimError, match="use renderer=tiny"):
        Stage("egl", None)


def test_the_decimated_arm_looks_like_the_arm(joints: np.ndarray) -> None:
    """Against PyBullet's meshes at P2D's size: the same silhouette, the same colours except in a few pixels."""
    model = panda.arm_model()
    pictures = []
    for urdf in (model.visual, model.original):
        stage = Stage("tiny", replace(model, visual=urdf))
        stage.pose_joints(joints)
        pictures.append(stage.draw(Camera(), 128))
        stage.close()
    (rgb, _, ids), (original_rgb, _, original_ids) = pictures
    both = (ids > 0) & (original_ids > 0)
    assert np.count_nonzero(both) / np.count_nonzero((ids > 0) | (original_ids > 0)) > 0.95
    difference = np.abs(rgb[both].astype(int) - original_rgb[both]).max(axis=-1)
    assert np.median(difference) < 12
    assert (difference > 80).mean() < 0.06
