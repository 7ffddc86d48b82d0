"""Whole trajectories: reproducible bytes, exact labels, plausible motion."""

from __future__ import annotations

import dataclasses
import hashlib
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("pybullet")

from sims.assets import object_models
from sims.errors import SimError
from sims.objects import CATALOGUE
from sims.p2d import simulate as module
from sims.p2d.settings import Settings
from sims.p2d.simulate import camera, progress, simulate
from sims.p2d.spec import sample
from sims.p2d.trajectory import ARM_ID, BACKGROUND_ID, FIRST_OBJECT_ID, Trajectory
from sims.poses import moved

SETTINGS = Settings(frames=4, image_size=64)
INDICES = (0, 3, 5, 1)


def digest(trajectory: Trajectory) -> str:
    """Of all fields' bytes."""
    content = hashlib.sha256()
    for field in dataclasses.fields(trajectory):
        content.update(np.asarray(getattr(trajectory, field.name)).tobytes())
    return content.hexdigest()


@pytest.fixture(scope="module")
def trajectories() -> dict[int, Trajectory]:
    return {index: simulate(SETTINGS, "train", index) for index in INDICES}


def test_bytes_depend_on_no_order(trajectories: dict[int, Trajectory]) -> None:
    simulate(SETTINGS, "val", 7)
    for index in reversed(INDICES):
        assert digest(simulate(SETTINGS, "train", index)) == digest(trajectories[index])
    assert len({digest(trajectory) for trajectory in trajectories.values()}) == len(INDICES)


def test_bytes_depend_on_no_process(trajectories: dict[int, Trajectory]) -> None:
    code = (
        "from sims.p2d.settings import Settings; from sims.p2d.simulate import simulate; import dataclasses, hashlib;"
        "import numpy as np; t = simulate(Settings(frames=4, image_size=64), 'train', 5); h = hashlib.sha256();"
        "[h.update(np.asarray(getattr(t, f.name)).tobytes()) for f in dataclasses.fields(t)]; print(h.hexdigest())"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.split()[-1] == digest(trajectories[5])


def test_splits_and_seeds_are_different_data(trajectories: dict[int, Trajectory]) -> None:
    others = [simulate(SETTINGS, "val", 5), simulate(SETTINGS.model_copy(update={"seed": 1}), "train", 5)]
    assert digest(trajectories[5]) not in [digest(other) for other in others]


def test_shapes_and_types(trajectories: dict[int, Trajectory]) -> None:
    expected = {
        "rgb": ((4, 64, 64, 3), np.uint8),
        "segmentation": ((4, 64, 64), np.uint8),
        "depth": ((4, 64, 64), np.float16),
        "classes": ((3,), np.int16),
        "poses": ((4, 3, 7), np.float32),
        "joints": ((4, 9), np.float32),
        "gripper": ((4, 7), np.float32),
        "visible_px": ((4, 4), np.int32),
        "amodal_px": ((4, 4), np.int32),
        "arm_contact": ((4, 3), np.bool_),
        "object_contact": ((4, 3, 3), np.bool_),
    }
    for trajectory in trajectories.values():
        for name, (shape, dtype) in expected.items():
            array = getattr(trajectory, name)
            assert (array.shape, array.dtype) == (shape, np.dtype(dtype)), name


def test_labels_fit_together(trajectories: dict[int, Trajectory]) -> None:
    for trajectory in trajectories.values():
        used = trajectory.classes >= 0
        count = int(used.sum())
        assert used[:count].all()
        ids = set(np.unique(trajectory.segmentation).tolist())
        assert {BACKGROUND_ID, ARM_ID} <= ids <= set(range(FIRST_OBJECT_ID + count))
        for part in range(4):
            pixels = (trajectory.segmentation == ARM_ID + part).sum(axis=(1, 2))
            np.testing.assert_array_equal(trajectory.visible_px[:, part], pixels)
        assert (trajectory.amodal_px >= trajectory.visible_px).all()
        assert (trajectory.amodal_px[:, : count + 1] > 0).all()
        assert (trajectory.amodal_px[:, count + 1 :] == 0).all()
        assert np.isfinite(trajectory.poses[:, :count]).all()
        assert np.isnan(trajectory.poses[:, count:]).all()
        np.testing.assert_allclose(np.linalg.norm(trajectory.poses[:, :count, 3:], axis=-1), 1, atol=1e-5)
        assert (trajectory.object_contact == trajectory.object_contact.transpose(0, 2, 1)).all()
        assert not trajectory.arm_contact[0].any()
        shares = trajectory.visible_px[:, 1 : count + 1] / trajectory.amodal_px[:, 1 : count + 1]
        assert shares.max(axis=0).min() >= 0.4


def test_stored_poses_and_camera_put_objects_where_their_masks_are(trajectories: dict[int, Trajectory]) -> None:
    """With nothing but what is stored, as a user would: intrinsics, extrinsics, poses."""
    lens = camera(SETTINGS)
    intrinsics, extrinsics = np.array(lens["intrinsics"]), np.array(lens["extrinsics"])
    models = object_models(SETTINGS.objects)
    checked = 0
    for trajectory in trajectories.values():
        for frame in range(4):
            for slot in np.flatnonzero(trajectory.classes >= 0):
                if trajectory.visible_px[frame, 1 + slot] < trajectory.amodal_px[frame, 1 + slot]:
                    continue
                points = moved(models[trajectory.classes[slot]].vertices, trajectory.poses[frame, slot].astype(float))
                inside = points @ extrinsics[:3, :3].T + extrinsics[:3, 3]
                pixels = inside @ intrinsics.T
                pixels = pixels[:, :2] / pixels[:, 2:]
                rows, columns = np.nonzero(trajectory.segmentation[frame] == FIRST_OBJECT_ID + slot)
                assert pixels.min(axis=0) == pytest.approx([columns.min(), rows.min()], abs=1.2)
                assert pixels.max(axis=0) == pytest.approx([columns.max() + 1, rows.max() + 1], abs=1.2)
                depth = trajectory.depth[frame][rows, columns].astype(float)
                assert inside[:, 2].min() - 2e-3 < depth.min() < depth.max() < inside[:, 2].max() + 2e-3
                checked += 1
    assert checked > 5


def test_motion_is_plausible(trajectories: dict[int, Trajectory]) -> None:
    models = object_models(SETTINGS.objects)
    for index, trajectory in trajectories.items():
        spec = sample(SETTINGS, "train", index, trajectory.redraws)
        for slot in np.flatnonzero(trajectory.classes >= 0):
            for pose in trajectory.poses[:, slot].astype(float):
                points = moved(models[trajectory.classes[slot]].touching, pose)
                assert -0.006 < points[:, 2].min() < 0.02  # nothing sinks, nothing flies
            touched = trajectory.arm_contact[:, slot].any() or trajectory.object_contact[:, slot].any()
            if not touched:
                assert (trajectory.poses[:, slot] == trajectory.poses[0, slot]).all()
        line = np.array([[*spec.start, spec.height_m], [*spec.end, spec.height_m]])
        np.testing.assert_allclose(trajectory.gripper[[0, -1], :3], line, atol=0.01)
        along = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0])
        way = trajectory.gripper[:, :3] - line[0]
        assert np.linalg.norm(way - np.outer(way @ along, along), axis=1).max() < 0.005


def test_fewer_frames_show_the_same_push() -> None:
    many = simulate(Settings(frames=7, image_size=32), "train", 5)
    few = simulate(Settings(frames=3, image_size=32), "train", 5)
    np.testing.assert_allclose(few.gripper[[0, 2]], many.gripper[[0, 6]])
    np.testing.assert_allclose(few.poses[[0, 2]], many.poses[[0, 6]], atol=2e-3)
    assert simulate(Settings(frames=1, image_size=32), "train", 5).rgb.shape == (1, 32, 32, 3)


def test_progress_runs_from_start_to_end_at_one_speed() -> None:
    time_s = np.linspace(0, 3, 301)
    share = progress(time_s, 3.0)
    assert share[0] == 0
    assert share[-1] == pytest.approx(1)
    speed = np.diff(share) / 0.01
    assert (speed >= 0).all()
    np.testing.assert_allclose(speed[30:-30], speed[150])
    assert speed[0] < 0.05
    assert speed[-1] < 0.05


def test_unusable_attempts_are_counted_and_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = Settings(frames=2, image_size=32, max_redraws=2)
    real, calls = module.push, []

    def spoiled(*words: object) -> module.Episode:
        calls.append(1)
        if len(calls) <= 2:
            raise module.Unusable("an object left the table")
        return real(*words)  # type: ignore[arg-type]

    monkeypatch.setattr(module, "push", spoiled)
    assert simulate(settings, "train", 5).redraws == 2

    def hopeless(*words: object) -> module.Episode:
        raise module.Unusable("an object left the table")

    monkeypatch.setattr(module, "push", hopeless)
    with pytest.raises(SimError, match=r"no usable push in 3 attempts \(the last: an object left the table\)"):
        simulate(settings, "train", 5)


@pytest.mark.slow
def test_statistics_of_many_trajectories() -> None:
    """What sims.md asks for, over 60 trajectories: contacts, visible objects, sizes, nothing cut off, balance."""
    settings = Settings(image_size=64, frames=10)
    pushed, visible, areas, edges, redraws = [], [], [], [], []
    classes = np.zeros(len(CATALOGUE), dtype=int)
    for index in range(60):
        trajectory = simulate(settings, "train", index)
        used = np.flatnonzero(trajectory.classes >= 0)
        classes[trajectory.classes[used]] += 1
        shift = np.linalg.norm(trajectory.poses[:, used, :3] - trajectory.poses[:1, used, :3], axis=-1).max(axis=0)
        pushed.append(bool(((shift >= 0.02) & trajectory.arm_contact[:, used].any(axis=0)).any()))
        shown = trajectory.visible_px > 0
        visible += shown.sum(axis=1).tolist()
        areas += (trajectory.visible_px[shown] / 64**2).tolist()
        border = np.ones((64, 64), dtype=bool)
        border[1:-1, 1:-1] = False
        edges.append((trajectory.segmentation[:, border] >= FIRST_OBJECT_ID).any(axis=1).mean())
        redraws.append(trajectory.redraws)
        assert (trajectory.amodal_px[:, 1 + used] / 64**2).min() > 0.004  # none is tiny
    assert np.mean(pushed) >= 1 / 3
    assert 2.4 < np.mean(visible) < 3.1
    assert 0.05 < np.mean(areas) < 0.075
    assert np.mean(edges) < 0.03
    assert np.mean(redraws) < 1
    assert (classes > 0).all()
