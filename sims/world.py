"""The physics simulation: a table, objects and an arm, rebuilt from scratch for every episode."""

from __future__ import annotations

from math import hypot

import numpy as np

from sims import arm as panda
from sims.assets import ObjectModel
from sims.background import TABLE_HIGH_M, TABLE_LOW_M, TABLE_THICKNESS_M
from sims.bullet import Client

STEPS_PER_S = 240
TOUCH_M = 0.0005
"""Bodies closer than this are in contact."""
POSITION_GAINS, VELOCITY_GAINS = (0.3,) * 9, (1.0,) * 9


class World:
    """A physics server; `rebuild` resets it completely, so episodes are independent of each other."""

    def __init__(self) -> None:
        self.bullet = Client()
        # Functions that are called at every step are looked up once.
        self._step, self._set_motors, self._contact_points = (
            self.bullet.bound(name) for name in ("stepSimulation", "setJointMotorControlArray", "getContactPoints")
        )
        self.arm_urdf = str(panda.arm_model().physics)
        self.arm = -1
        self.table = -1
        self.objects: list[int] = []

    def rebuild(self) -> None:
        """Reset the simulation to an empty table."""
        bullet = self.bullet
        bullet.call("resetSimulation")
        bullet.call("setGravity", 0.0, 0.0, -9.81)
        bullet.call(
            "setPhysicsEngineParameter",
            fixedTimeStep=1 / STEPS_PER_S,
            numSolverIterations=30,
            deterministicOverlappingPairs=1,
        )
        low, high = np.array(TABLE_LOW_M), np.array(TABLE_HIGH_M)
        half = [*((high - low) / 2).tolist(), TABLE_THICKNESS_M / 2]
        shape = bullet.call("createCollisionShape", bullet.module.GEOM_BOX, halfExtents=half)
        place = [*((high + low) / 2).tolist(), -TABLE_THICKNESS_M / 2]
        self.table = bullet.call("createMultiBody", 0.0, shape, -1, place)
        bullet.call("changeDynamics", self.table, -1, lateralFriction=0.6, restitution=0.0)
        self.arm, self.objects = -1, []

    def add_object(self, model: ObjectModel, position: np.ndarray, quaternion: np.ndarray) -> int:
        """Add an object with its frame at a position (metres) and quaternion (x, y, z, w); returns its body number."""
        bullet = self.bullet
        shape = bullet.call("createCollisionShape", bullet.module.GEOM_MESH, fileName=str(model.collision))
        body = bullet.call("createMultiBody", model.mass_kg, shape, -1, position.tolist(), quaternion.tolist())
        bullet.call(
            "changeDynamics",
            body,
            -1,
            lateralFriction=0.6,
            spinningFriction=0.002,
            rollingFriction=0.0005,
            restitution=0.0,
            linearDamping=0.04,
            angularDamping=0.1,
        )
        self.objects.append(body)
        return int(body)

    def add_arm(self) -> int:
        """Load the arm with its base at the origin; returns its body number."""
        self.arm = self.bullet.call("loadURDF", self.arm_urdf, [0, 0, 0], useFixedBase=True)
        for joint in range(self.bullet.call("getNumJoints", self.arm)):
            self.bullet.call("changeDynamics", self.arm, joint, lateralFriction=0.5, restitution=0.0)
        return int(self.arm)

    def drive(self, positions: list[float], speeds: list[float]) -> None:
        """Set the motors' targets: (9,) joint angles and finger positions, and their speeds."""
        self._set_motors(
            self.arm,
            panda.JOINTS,
            self.bullet.module.POSITION_CONTROL,
            targetPositions=positions,
            targetVelocities=speeds,
            forces=panda.FORCE_N,
            positionGains=POSITION_GAINS,
            velocityGains=VELOCITY_GAINS,
        )

    def step(self) -> None:
        """Advance by 1 / `STEPS_PER_S` seconds."""
        self._step()

    def poses(self) -> np.ndarray:
        """(O, 7) x, y, z in metres and quaternion x, y, z, w of every object's frame."""
        states = [self.bullet.call("getBasePositionAndOrientation", body) for body in self.objects]
        return np.array([[*position, *quaternion] for position, quaternion in states])

    def fastest(self) -> tuple[float, float]:
        """Largest linear speed (m/s) and largest angular speed (rad/s) over all objects."""
        states = [self.bullet.call("getBaseVelocity", body) for body in self.objects]
        return max(hypot(*linear) for linear, _ in states), max(hypot(*angular) for _, angular in states)

    def joints(self) -> np.ndarray:
        """(9,) joint angles in radians, finger positions in metres."""
        return np.array([state[0] for state in self.bullet.call("getJointStates", self.arm, panda.JOINTS)])

    def gripper(self) -> np.ndarray:
        """(7,) pose of the point between the fingertips."""
        state = self.bullet.call("getLinkState", self.arm, panda.GRASP_LINK, computeForwardKinematics=True)
        return np.array([*state[4], *state[5]])

    def gap(self, body: int, reach_m: float) -> float:
        """Smallest distance in metres between the arm and a body; `inf` beyond `reach_m`."""
        points = self.bullet.call("getClosestPoints", self.arm, body, reach_m)
        return min((point[8] for point in points), default=np.inf)

    def contacts(self) -> tuple[list[int], list[tuple[int, int]]]:
        """Current contacts: indices of the objects that touch the arm, and index pairs of objects that touch."""
        contact_points, objects = self._contact_points, self.objects
        number = {body: i for i, body in enumerate(objects)}
        with_arm: set[int] = set()
        if self.arm >= 0:
            with_arm = {point[2] for point in contact_points(self.arm) if point[8] <= TOUCH_M}
        pairs = []
        for i, body in enumerate(objects):
            for j in range(i + 1, len(objects)):
                points = contact_points(body, objects[j])
                if any(point[8] <= TOUCH_M for point in points):
                    pairs.append((i, j))
        return sorted(number[body] for body in with_arm if body in number), pairs
