"""The robot cell: the simulated table with the arm and a gripper that grasps by friction, driven along paths.

The controller sees of it the joint positions and the gripper's width alone (`joints`, `width`); `world` is for the
camera and the judge.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import PchipInterpolator

from sims import arm as panda
from sims.arrangement.scenario import Placement
from sims.assets import object_models
from sims.world import STEPS_PER_S, World

FINGERS = (9, 10)
"""PyBullet's joints and links of the fingers."""
PAD_FRICTION = 1.0
"""Rubber pads; the coefficient of a contact is the product of both bodies' coefficients."""
SOLVER_ITERATIONS = 60
OPEN_M = 0.04
"""Position of each finger of the open gripper."""
RETRACTED = (0.0, -1.17, 0.0, -2.616, 0.0, 1.446, 0.785)
"""Joint angles (rad) at which the camera does not see the arm."""
SPEED_RAD_S, ACCELERATION_S = 1.6, 0.15
"""Highest speed of a joint, and the time to reach it."""
SETTLE_S, CALM_S = 0.5, 0.08
BLOCKED_RAD = 0.08
"""The arm is blocked if a joint lags behind its target by more than this."""
WATCH_STEPS = 8
FINGER_M_S = 0.1


class Blocked(Exception):
    """The arm met something on its way."""


class Cell:
    """One physics server with objects, arm and gripper. Time is simulated."""

    def __init__(self) -> None:
        self.world = World()
        self.steps = 0
        self.fingers = OPEN_M
        self.on_step: Callable[[int], None] | None = None
        """Called with the number of steps made, after each."""

    @property
    def time_s(self) -> float:
        """Seconds since `load`."""
        return self.steps / STEPS_PER_S

    def load(self, placements: tuple[Placement, ...]) -> None:
        """Rebuild the cell with objects, the arm retracted and the gripper open, and let everything come to rest."""
        world, bullet = self.world, self.world.bullet
        self.on_step = None
        world.rebuild()
        bullet.call("setPhysicsEngineParameter", numSolverIterations=SOLVER_ITERATIONS)
        for placement, model in zip(placements, object_models(tuple(p.name for p in placements)), strict=True):
            world.add_object(model, np.array(placement.position), np.array(placement.quaternion))
        arm = world.add_arm()
        for link in FINGERS:
            bullet.call("changeDynamics", arm, link, lateralFriction=PAD_FRICTION, spinningFriction=0.005)
        # The fingers of the Panda's hand are coupled by a gear; the URDF's mimic joint is not simulated.
        gear = bullet.call(
            "createConstraint", arm, FINGERS[0], arm, FINGERS[1], bullet.module.JOINT_GEAR, [1, 0, 0], [0] * 3, [0] * 3
        )
        bullet.call("changeConstraint", gear, gearRatio=-1, erp=0.1, maxForce=50)
        self.fingers = OPEN_M
        for joint, value in zip(panda.JOINTS, [*RETRACTED, OPEN_M, OPEN_M], strict=True):
            bullet.call("resetJointState", arm, joint, value, 0.0)
        self.hold(SETTLE_S)
        self.steps = 0

    def joints(self) -> np.ndarray:
        """(7,) angles in radians."""
        return self.world.joints()[:7]

    def width(self) -> float:
        """Distance between the fingers in metres."""
        return float(self.world.joints()[7:].sum())

    def hold(self, seconds: float) -> None:
        """Keep the arm where it is."""
        here = self.joints()
        for _ in range(round(seconds * STEPS_PER_S)):
            self._step(here.tolist(), [0.0] * 7)

    def grip(self, finger_m: float) -> None:
        """Move the fingers to a position each, or until something holds them up, and wait until they rest."""
        here, start = self.joints().tolist(), self.fingers
        steps = max(1, round(abs(finger_m - start) / FINGER_M_S * STEPS_PER_S))
        for step in range(1, steps + 1):
            self.fingers = start + (finger_m - start) * step / steps
            self._step(here, [0.0] * 7)
        self.hold(CALM_S)

    def follow(self, path: np.ndarray, speed: float = 1.0, stubborn: bool = False) -> None:
        """Move the arm along joint angles (N, 7), the first of which are its own.

        Args:
            speed: share of the full speed.
            stubborn: push against what blocks the arm.

        Raises:
            Blocked: a joint did not follow; the arm stands still then.
        """
        way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(path, axis=0)).max(axis=1))])
        new = np.concatenate([[True], np.diff(way) > 1e-6])
        path, way = path[new], way[new]
        if len(path) < 2:
            return
        curve = PchipInterpolator(way, path)
        duration = way[-1] / (SPEED_RAD_S * speed) + ACCELERATION_S
        count = int(np.ceil(duration * STEPS_PER_S))
        angles = curve(way[-1] * _progress(np.arange(count + 1) / count, ACCELERATION_S / duration))
        speeds = np.diff(angles, axis=0) * STEPS_PER_S
        for step, (target, rate) in enumerate(zip(angles[1:].tolist(), speeds.tolist(), strict=True)):
            self._step(target, rate)
            if not stubborn and step % WATCH_STEPS == 0 and np.abs(self.joints() - target).max() > BLOCKED_RAD:
                self.hold(CALM_S)
                raise Blocked
        for _ in range(round(CALM_S * STEPS_PER_S)):
            self._step(path[-1].tolist(), [0.0] * 7)

    def _step(self, angles: list[float], speeds: list[float]) -> None:
        self.world.drive([*angles, self.fingers, self.fingers], [*speeds, 0.0, 0.0])
        self.world.step()
        self.steps += 1
        if self.on_step is not None:
            self.on_step(self.steps)


def _progress(share: np.ndarray, ramp: float) -> np.ndarray:
    """Share of the way covered at a share of the time: constant speed with a smooth start and stop of `ramp` each."""
    late = 1 - share
    top = 1 / (1 - ramp)
    rising, falling = top * share**2 / (2 * ramp), 1 - top * late**2 / (2 * ramp)
    return np.where(share < ramp, rising, np.where(late < ramp, falling, top * (share - ramp / 2)))
