"""Collision-checked motions of the arm among bodies that perception has found.

The planner has a physics server of its own that is never stepped: the arm, the table and a box per body. It knows
nothing of the simulated scene. `pybullet-planning` offers such functions, but for one server per process, whose number
it keeps in a module variable; here each process has several.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sims import arm as panda
from sims.arrangement.cell import OPEN_M, RETRACTED
from sims.arrangement.cloud import Body
from sims.background import TABLE_HIGH_M, TABLE_LOW_M
from sims.bullet import Client

IK_CALLS, IK_ERROR_M, IK_ERROR_RAD = 8, 5e-4, 5e-3
CLEAR_M = 0.004
"""Minimum distance of the arm from every body."""
HELD_CLEAR_M = 0.0005
"""Minimum distance of what it holds: a body may have stood close to another before it was lifted."""
TABLE_CLEAR_M = 0.002
GROWN_M = 0.004
"""Boxes are this much wider than what the camera saw, on all sides."""
STEP_M, STEP_RAD = 0.025, 0.12
"""Distance of the configurations of a path that are checked: of a straight line, of a path of joint angles."""
FIRST_LINK = 3
"""Links before this one cannot reach the table."""
FAR_M = 10.0


class Exhausted(Exception):
    """The planner has made as many comparisons as it may in this episode."""


class Planner:
    """Inverse kinematics and collision checks.

    Its work is counted in comparisons rather than seconds, so that an outcome does not depend on the machine: one for
    every inverse kinematics, and for every body that a configuration of the arm is compared with.
    """

    def __init__(self) -> None:
        self.bullet = Client()
        self.arm = int(self.bullet.call("loadURDF", str(panda.arm_model().physics), [0, 0, 0], useFixedBase=True))
        middle = [(low + high) / 2 for low, high in zip(TABLE_LOW_M, TABLE_HIGH_M, strict=True)]
        half = [(high - low) / 2 for low, high in zip(TABLE_LOW_M, TABLE_HIGH_M, strict=True)]
        self.table = self._box([*half, 0.05], [*middle, -0.05], 0.0)
        self.boxes: list[int] = []
        self.held = -1
        self.compared, self.limit = 0, 0
        self._held_at = (np.zeros(3), 0.0)

    def begin(self, limit: int) -> None:
        """Start an episode with a limit to the comparisons."""
        self.compared, self.limit = 0, limit

    def go_on(self) -> None:
        """Called before every piece of planning.

        Raises:
            Exhausted: the limit is reached.
        """
        if self.compared >= self.limit:
            raise Exhausted

    def show(self, bodies: Sequence[Body]) -> None:
        """Replace the obstacles."""
        for box in self.boxes:
            self.bullet.call("removeBody", box)
        self.boxes = [
            self._box(
                [body.sides[0] / 2 + GROWN_M, body.sides[1] / 2 + GROWN_M, body.height / 2],
                [*body.centre.tolist(), body.height / 2],
                body.yaw,
            )
            for body in bodies
        ]

    def hold(self, body: Body, point: np.ndarray, yaw: float) -> None:
        """Put a body into the hand that grasps it at a point (3,) with a yaw; it must not be among the obstacles."""
        self.release()
        self.held = self._box([body.sides[0] / 2, body.sides[1] / 2, body.height / 2], [0, 0, FAR_M], 0.0)
        middle = np.array([*body.centre, body.height / 2])
        # Seen from the hand, which looks down: turned about the vertical only.
        self._held_at = (_turn(-yaw) @ (middle - point), body.yaw - yaw)

    def release(self) -> None:
        """Take the body out of the hand."""
        if self.held >= 0:
            self.bullet.call("removeBody", self.held)
        self.held = -1

    def reach(self, point: np.ndarray, yaw: float, seed: np.ndarray | None = None) -> np.ndarray | None:
        """Joint angles (7,) with the point between the fingertips at `point` (3,), the hand down; None out of reach.

        Args:
            yaw: of the hand in radians; the fingers open perpendicular to it.
            seed: angles to start from; None: the arm at rest, turned towards the point.
        """
        self.compared += 1
        down = self.bullet.call("getQuaternionFromEuler", (np.pi, 0.0, yaw))
        if seed is None:
            seed = np.array(panda.REST_RAD)
            seed[0] = np.arctan2(point[1], point[0])
            seed[6] = panda.REST_RAD[6] + seed[0] - yaw
            seed[6] = np.clip(seed[6], panda.LOWER_RAD[6] + 0.05, panda.UPPER_RAD[6] - 0.05)
        bounds = {
            "lowerLimits": panda.LOWER_RAD,
            "upperLimits": panda.UPPER_RAD,
            "jointRanges": np.subtract(panda.UPPER_RAD, panda.LOWER_RAD).tolist(),
            "restPoses": seed.tolist(),
            "maxNumIterations": 40,
            "residualThreshold": 1e-6,
        }
        self._pose(seed)
        for _ in range(IK_CALLS):
            angles = np.array(
                self.bullet.call(
                    "calculateInverseKinematics", self.arm, panda.GRASP_LINK, point.tolist(), down, **bounds
                )[:7]
            )
            self._pose(angles)
            state = self.bullet.call("getLinkState", self.arm, panda.GRASP_LINK, computeForwardKinematics=True)
            near = np.linalg.norm(np.subtract(state[4], point)) < IK_ERROR_M
            turned = 2 * np.arccos(min(1.0, abs(float(np.dot(state[5], down)))))
            if near and turned < IK_ERROR_RAD:
                within = (angles > panda.LOWER_RAD).all() and (angles < panda.UPPER_RAD).all()
                return angles if within else None
        return None

    def where(self, angles: np.ndarray) -> tuple[np.ndarray, float]:
        """Point between the fingertips (3,) in metres and the hand's yaw at joint angles (7,)."""
        self._pose(angles)
        state = self.bullet.call("getLinkState", self.arm, panda.GRASP_LINK, computeForwardKinematics=True)
        return np.array(state[4]), float(self.bullet.call("getEulerFromQuaternion", state[5])[2])

    def straight(
        self, start: np.ndarray, point: np.ndarray, yaw: float, end: np.ndarray, end_yaw: float, fingers: float
    ) -> np.ndarray | None:
        """Joint angles (N, 7) along a straight line, from `start` (7,) at `point`; None if something is in the way."""
        way = float(np.linalg.norm(end - point))
        count = int(np.ceil(max(way / STEP_M, abs(end_yaw - yaw) / STEP_RAD, 1.0)))
        path = [start]
        for share in np.linspace(0, 1, count + 1)[1:].tolist():
            angles = self.reach(point + share * (end - point), yaw + share * (end_yaw - yaw), path[-1])
            if angles is None or not self.free(angles, fingers):
                return None
            path.append(angles)
        return np.array(path)

    def swing(self, start: np.ndarray, end: np.ndarray, fingers: float) -> np.ndarray | None:
        """Joint angles (N, 7) from one configuration straight to another; None if something is in the way."""
        count = int(np.ceil(max(np.abs(end - start).max() / STEP_RAD, 1)))
        path = start + np.linspace(0, 1, count + 1)[:, None] * (end - start)
        return path if all(self.free(angles, fingers) for angles in path[1:]) else None

    def free(self, angles: np.ndarray, fingers: float = OPEN_M) -> bool:
        """Whether the arm, and what it holds, keep clear of all bodies."""
        self.compared += 1 + len(self.boxes)
        self._pose(angles, fingers)
        call = self.bullet.call
        table = call("getClosestPoints", self.arm, self.table, TABLE_CLEAR_M)
        if any(point[3] >= FIRST_LINK for point in table):
            return False
        if any(call("getClosestPoints", self.arm, box, CLEAR_M) for box in self.boxes):
            return False
        if self.held < 0:
            return True
        state = call("getLinkState", self.arm, panda.GRASP_LINK, computeForwardKinematics=True)
        point, yaw = np.array(state[4]), call("getEulerFromQuaternion", state[5])[2]
        shift, turn = self._held_at
        place = point + _turn(yaw) @ shift
        call("resetBasePositionAndOrientation", self.held, place.tolist(), _quaternion(yaw + turn))
        return not any(call("getClosestPoints", self.held, box, HELD_CLEAR_M) for box in self.boxes)

    def _pose(self, angles: np.ndarray, fingers: float = OPEN_M) -> None:
        for joint, angle in zip(panda.JOINTS, [*angles.tolist(), fingers, fingers], strict=True):
            self.bullet.call("resetJointState", self.arm, joint, angle)

    def _box(self, half: list[float], place: list[float], yaw: float) -> int:
        shape = self.bullet.call("createCollisionShape", self.bullet.module.GEOM_BOX, halfExtents=half)
        return int(self.bullet.call("createMultiBody", 0.0, shape, -1, place, _quaternion(yaw)))


def _turn(yaw: float) -> np.ndarray:
    """(3, 3) rotation about the vertical."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _quaternion(yaw: float) -> list[float]:
    return [0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2))]


HOME = np.array(RETRACTED)
