"""A rendering-only PyBullet server: posed bodies, no physics, so an image depends on poses alone."""

from __future__ import annotations

import importlib.util
from functools import lru_cache
from typing import Literal

import numpy as np

from sims import arm as panda
from sims.assets import ObjectModel
from sims.bullet import Client
from sims.camera import Camera
from sims.errors import SimError

Backend = Literal["tiny", "egl"]

ARM_ID, FIRST_OBJECT_ID = 1, 2
HIDDEN_POSE = np.array([0.0, 0.0, -50.0, 0.0, 0.0, 0.0, 1.0])

LIGHT_DIRECTION = (0.35, -0.5, 1.0)
AMBIENT, DIFFUSE, SPECULAR = 0.58, 0.52, 0.04


class Stage:
    """Arm and objects without a background, seen by any camera.

    Args:
        backend: 'tiny' renders on the CPU; 'egl' needs EGL, which GPU drivers provide.
        arm: the arm's model; None for a stage without it.

    Raises:
        SimError: the EGL renderer cannot be loaded.
    """

    def __init__(self, backend: Backend, arm: panda.ArmModel | None) -> None:
        self.backend = backend
        self.bullet = Client()
        module = self.bullet.module
        if backend == "egl":
            load_egl(self.bullet)
        self._renderer = module.ER_BULLET_HARDWARE_OPENGL if backend == "egl" else module.ER_TINY_RENDERER
        self.bodies: list[int] = []
        self.arm = -1
        if arm is not None:
            # The GPU renders the original arm; the decimated one is for the CPU.
            urdf = str(arm.original if backend == "egl" else arm.visual)
            self.arm = int(self.bullet.call("loadURDF", urdf, [0, 0, 0], useFixedBase=True))
            self._arm_base = self.bullet.call("getBasePositionAndOrientation", self.arm)
        if backend == "egl":
            # EGL lights the very first image partly from defaults: render one and discard it.
            self.draw(Camera(), 16)

    def show(self, models: tuple[ObjectModel, ...]) -> None:
        """Replace the objects; each is out of sight until it is posed."""
        for body in self.bodies:
            self.bullet.call("removeBody", body)
        mesh = self.bullet.module.GEOM_MESH
        self.bodies = []
        for model in models:
            shape = self.bullet.call(
                "createVisualShape", mesh, fileName=str(model.detailed if self.backend == "egl" else model.visual)
            )
            body = self.bullet.call("createMultiBody", 0.0, -1, shape, HIDDEN_POSE[:3].tolist())
            self.bodies.append(int(body))

    def pose(self, body: int, pose: np.ndarray) -> None:
        """Move a body to x, y, z in metres and quaternion x, y, z, w."""
        self.bullet.call("resetBasePositionAndOrientation", body, pose[:3].tolist(), pose[3:].tolist())

    def show_arm(self, visible: bool) -> None:
        """Show or hide the arm; does nothing on a stage without one."""
        if self.arm >= 0:
            position, quaternion = self._arm_base if visible else (HIDDEN_POSE[:3].tolist(), (0, 0, 0, 1))
            self.bullet.call("resetBasePositionAndOrientation", self.arm, position, quaternion)

    def pose_joints(self, joints: np.ndarray) -> None:
        """Set the arm's joints: (9,) angles in radians and finger positions in metres."""
        for joint, value in zip(panda.JOINTS, joints.tolist(), strict=True):
            self.bullet.call("resetJointState", self.arm, joint, value)

    def draw(self, camera: Camera, size_px: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Colour (H, W, 3) uint8, depth (H, W) float64 in metres, ids (H, W) uint8: 0 empty, 1 arm, 2 + i object i.

        Depth is infinite in empty pixels.
        """
        view, projection = _matrices(camera, size_px, self.backend)
        _, _, rgba, buffer, bodies = self.bullet.call(
            "getCameraImage",
            size_px,
            size_px,
            view,
            projection,
            lightDirection=LIGHT_DIRECTION,
            lightColor=(1, 1, 1),
            lightAmbientCoeff=AMBIENT,
            lightDiffuseCoeff=DIFFUSE,
            lightSpecularCoeff=SPECULAR,
            shadow=0,
            renderer=self._renderer,
        )
        # Body numbers become ids by one table look-up; -1 (empty) indexes the last entry.
        known = [self.arm, *self.bodies]
        table = np.zeros(max(known) + 2, dtype=np.uint8)
        table[known] = np.arange(ARM_ID, ARM_ID + len(known))
        table[-1] = 0
        ids = table[np.reshape(bodies, (size_px, size_px))]
        seen = ids > 0
        depth = np.full(ids.shape, np.inf)
        depth[seen] = camera.metres(np.reshape(buffer, ids.shape)[seen].astype(np.float64))
        return np.reshape(rgba, (size_px, size_px, 4))[..., :3], depth, ids

    def close(self) -> None:
        """Free the server."""
        self.bullet.close()


def load_egl(bullet: Client) -> int:
    """Load PyBullet's EGL renderer into a server.

    Raises:
        SimError: this build of PyBullet lacks it, or no EGL display is found.
    """
    spec = importlib.util.find_spec("eglRenderer")
    if spec is None or spec.origin is None:
        raise SimError("renderer 'egl' is not part of this PyBullet (its wheels for Linux have it): use renderer=tiny.")
    plugin = int(bullet.call("loadPlugin", spec.origin, "_eglRendererPlugin"))
    if plugin < 0:
        raise SimError(
            "renderer 'egl' found no EGL display: use renderer=tiny, or a machine with a GPU and its driver."
        )
    return plugin


@lru_cache(maxsize=8)
def _matrices(camera: Camera, size_px: int, backend: Backend) -> tuple[list[float], list[float]]:
    """View and projection, the latter shifted so that a pixel is sampled at its centre.

    TinyRenderer samples a pixel at its lower left corner, half a pixel from where a camera's intrinsics have it.
    """
    projection = camera.projection_matrix()
    if backend == "tiny":
        projection[8] += 1 / size_px
        projection[9] += 1 / size_px
    return camera.view_matrix(), projection
