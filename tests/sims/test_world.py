"""Physics against hand calculation: rest, sliding friction, the arm on its line, contacts."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pybullet")

from sims import arm as panda
from sims.assets import object_models
from sims.world import STEPS_PER_S, World

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def world() -> World:
    return World()


def _put(world: World, name: str, x: float, y: float, lift: float = 0.0) -> int:
    (model,) = object_models((name,))
    return world.add_object(model, np.array([x, y, lift - model.touching[:, 2].min()]), model.rests[0][1])


def test_objects_stay_at_rest(world: World) -> None:
    world.rebuild()
    for name, y in (("sugar_box", -0.2), ("orange", 0.0), ("mug", 0.2)):
        _put(world, name, 0.5, y)
    for _ in range(60):
        world.step()
    before = world.poses()
    for _ in range(2 * STEPS_PER_S):
        world.step()
    assert np.abs(world.poses()[:, :3] - before[:, :3]).max() < 1e-3
    assert world.fastest()[0] < 0.005


def test_a_dropped_object_falls_as_bodies_fall(world: World) -> None:
    world.rebuild()
    _put(world, "foam_brick", 0.5, 0.0, lift=0.5)
    steps = STEPS_PER_S // 5
    start = world.poses()[0, 2]
    for _ in range(steps):
        world.step()
    time_s = steps / STEPS_PER_S
    fallen = start - world.poses()[0, 2]
    assert fallen == pytest.approx(9.81 * time_s**2 / 2, rel=0.05)


def test_a_sliding_box_stops_after_the_way_that_friction_allows(world: World) -> None:
    world.rebuild()
    body = _put(world, "pudding_box", 0.3, 0.0)
    for _ in range(60):
        world.step()
    start = world.poses()[0, :2]
    speed = 0.6
    world.bullet.call("resetBaseVelocity", body, [speed, 0, 0], [0, 0, 0])
    for _ in range(STEPS_PER_S):
        world.step()
    friction = (
        world.bullet.call("getDynamicsInfo", body, -1)[1] * world.bullet.call("getDynamicsInfo", world.table, -1)[1]
    )
    way = np.linalg.norm(world.poses()[0, :2] - start)
    assert way == pytest.approx(speed**2 / (2 * friction * 9.81), rel=0.15)


def test_the_arm_follows_a_straight_line_with_the_gripper_down(world: World) -> None:
    world.rebuild()
    arm = world.add_arm()
    line = np.linspace([0.4, -0.2, 0.02], [0.65, 0.15, 0.02], 8)
    angles, error = panda.joint_path(world.bullet, arm, line, 0.3)
    assert error < 1e-3
    assert (angles > panda.LOWER_RAD).all()
    assert (angles < panda.UPPER_RAD).all()
    for point, configuration in zip(line, angles, strict=True):
        panda.reset(world.bullet, arm, configuration)
        pose = world.gripper()
        np.testing.assert_allclose(pose[:3], point, atol=1e-3)
        matrix = np.reshape(world.bullet.module.getMatrixFromQuaternion(pose[3:].tolist()), (3, 3))
        assert matrix[2, 2] < -0.999


def test_points_out_of_reach_are_noticed(world: World) -> None:
    world.rebuild()
    arm = world.add_arm()
    _, error = panda.joint_path(world.bullet, arm, np.array([[0.5, 0.0, 0.02], [1.4, 0.0, 0.02]]), 0.0)
    assert error > 0.1


def test_motors_hold_the_arm_and_contacts_are_reported(world: World) -> None:
    world.rebuild()
    _put(world, "sugar_box", 0.5, 0.0)
    _put(world, "cracker_box", 0.5, 0.3)
    arm = world.add_arm()
    angles, _ = panda.joint_path(world.bullet, arm, np.linspace([0.5, -0.18, 0.02], [0.5, 0.0, 0.02], 48), 0.0)
    world.step()
    assert world.contacts() == ([], [])
    assert world.gap(world.objects[0], 0.5) > 0.01
    touched = set()
    for position in np.repeat(angles, 6, axis=0):
        world.drive([*position.tolist(), 0.0, 0.0], [0.0] * 9)
        world.step()
        touched |= set(world.contacts()[0])
    assert touched == {0}
    np.testing.assert_allclose(world.joints()[:7], angles[-1], atol=0.03)
    assert world.poses()[0, 1] > 0.01


def test_touching_objects_are_a_pair(world: World) -> None:
    world.rebuild()
    (model,) = object_models(("foam_brick",))
    length = np.ptp(model.touching[:, 0])
    for x in (0.5, 0.5 + 0.995 * length):
        world.add_object(model, np.array([x, 0.0, -model.touching[:, 2].min()]), LEVEL)
    world.step()
    assert world.contacts() == ([], [(0, 1)])


def test_the_drawn_arm_has_few_faces_and_the_touching_arm_draws_nothing() -> None:
    model = panda.arm_model()
    faces = sum(path.read_text().count("\nf ") for path in model.visual.parent.glob("*_visual.obj"))
    assert faces <= 0.05 * 101_735
    assert "<visual>" not in model.physics.read_text()
    assert "<collision>" not in model.visual.read_text()
