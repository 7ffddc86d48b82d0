"""The sampled specification of a trajectory, before any physics."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("pybullet")

from sims.assets import object_models
from sims.p2d.settings import Settings
from sims.p2d.spec import GRIPPER_M, NoRoom, Spec, sample
from sims.rectangles import rectangle, separate

SETTINGS = Settings()


@pytest.fixture(scope="module")
def specs() -> list[Spec]:
    return [sample(SETTINGS, "train", index) for index in range(150)]


def test_the_same_key_gives_the_same_spec_and_others_do_not() -> None:
    spec = sample(SETTINGS, "val", 3)
    assert spec == sample(SETTINGS, "val", 3)
    others = [sample(SETTINGS, "test", 3), sample(SETTINGS, "val", 4), sample(Settings(seed=1), "val", 3)]
    assert all(spec.start != other.start for other in others)
    again = sample(SETTINGS, "val", 3, attempt=1)
    assert again.start != spec.start
    assert [p.class_index for p in again.objects] == [p.class_index for p in spec.objects]
    assert again.aimed == spec.aimed


def test_a_trajectory_does_not_depend_on_the_sizes_of_the_splits() -> None:
    """Trajectory i is the same in a small and in a large data set."""
    assert sample(Settings(train=5, frames=4), "train", 2) == sample(SETTINGS, "train", 2)


def test_shares(specs: list[Spec]) -> None:
    counts = np.bincount([len(spec.objects) for spec in specs], minlength=4)
    assert counts[0] == 0
    assert counts[1:].min() > 30  # 50 each expected
    assert np.mean([spec.aimed for spec in specs]) == pytest.approx(0.5, abs=0.12)
    classes = np.bincount([p.class_index for spec in specs for p in spec.objects], minlength=14)
    assert classes.min() > 5  # 21 each expected
    assert all(len({p.class_index for p in spec.objects}) == len(spec.objects) for spec in specs)


def test_objects_stand_on_the_table_apart_and_in_the_picture(specs: list[Spec]) -> None:
    models = object_models(SETTINGS.objects)
    for spec in specs[:60]:
        hand = np.array(rectangle(np.array(spec.start), GRIPPER_M, spec.yaw_rad))
        clouds = []
        for placement in spec.objects:
            model = models[placement.class_index]
            turning = Rotation.from_quat(placement.quaternion)
            assert turning.apply(model.touching)[:, 2].min() + placement.position[2] == pytest.approx(0.0005, abs=1e-6)
            points = turning.apply(model.vertices) + placement.position
            pixels, _ = SETTINGS.camera.project(points, 128)
            assert pixels.min() >= 0
            assert pixels.max() <= 128
            clouds.append(points[:, :2])
        for i, cloud in enumerate(clouds):
            gaps = [np.linalg.norm(cloud[:, None] - other[None], axis=-1).min() for other in clouds[:i]]
            assert min(gaps, default=1) > 0.01
            assert np.linalg.norm(cloud[:, None] - hand[None], axis=-1).min() > 0.01


def test_aimed_lines_run_over_an_object(specs: list[Spec]) -> None:
    for spec in specs:
        start, end = np.array(spec.start), np.array(spec.end)
        length = np.linalg.norm(end - start)
        assert length >= 0.2 - 1e-9
        if spec.aimed:
            along = (end - start) / length
            places = np.array([placement.position[:2] for placement in spec.objects]) - start
            beside = np.abs(places @ [-along[1], along[0]])
            before = places @ along
            assert ((beside < 1e-9) & (before > 0) & (before < length)).any()


def test_no_room_is_one_sentence() -> None:
    crowded = Settings(min_objects=14, max_objects=14)
    with pytest.raises(NoRoom, match="make the workspace larger"):
        sample(crowded, "train", 0)


def test_separate_polygons() -> None:
    square = rectangle(np.zeros(2), (0.2, 0.2), 0.0)
    turned = rectangle(np.array([0.24, 0.0]), (0.2, 0.2), np.pi / 4)
    assert not separate(square, turned, 0.0)  # 0.24 - 0.1 - 0.1 * sqrt(2) < 0
    assert separate(square, turned + np.array([0.02, 0.0]), 0.0)
    assert not separate(square, turned + np.array([0.02, 0.0]), 0.02)
    np.testing.assert_allclose(rectangle(np.array([1.0, 2.0]), (0.4, 0.2), np.pi / 2)[0], [0.9, 2.2])


@pytest.mark.parametrize("count", [4, pytest.param(5, marks=pytest.mark.slow)])
def test_crowded_tables_keep_the_rules(count: int) -> None:
    """Drawn many at once, objects stand apart, whole in the picture, in slot order of their classes."""
    crowded = Settings(min_objects=count, max_objects=count)
    models = object_models(crowded.objects)
    found = []
    for index in range(10):
        try:
            found.append(sample(crowded, "train", index))
        except NoRoom:
            continue  # these classes find no room in this attempt; the next one draws again
    assert len(found) >= 5
    for spec in found:
        assert len({p.class_index for p in spec.objects}) == count
        clouds = []
        for placement in spec.objects:
            model = models[placement.class_index]
            turning = Rotation.from_quat(placement.quaternion)
            points = turning.apply(model.vertices) + placement.position
            assert turning.apply(model.touching)[:, 2].min() + placement.position[2] == pytest.approx(0.0005, abs=1e-6)
            pixels, _ = crowded.camera.project(points, 128)
            assert pixels.min() >= 0
            assert pixels.max() <= 128
            clouds.append(points[:, :2])
        for i, cloud in enumerate(clouds):
            assert all(np.linalg.norm(cloud[:, None] - other, axis=-1).min() > 0.01 for other in clouds[:i])


def test_places_of_up_to_three_objects_are_drawn_as_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bytes of published data sets depend on it."""

    def never(*_: object) -> None:
        raise AssertionError("drawn many at once")

    monkeypatch.setattr("sims.p2d.spec._place_crowded", never)
    assert len(sample(Settings(min_objects=3), "train", 0).objects) == 3
    with pytest.raises(AssertionError, match="many at once"):
        sample(Settings(min_objects=4, max_objects=4), "train", 0)
