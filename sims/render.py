"""Pictures of a posed scene: colour, ids and depth from one draw, and what each body covers when it stands alone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from sims import arm as panda
from sims import world
from sims.assets import ObjectModel
from sims.bullet import Client
from sims.camera import Camera
from sims.errors import SimError

Backend = Literal["tiny", "egl"]
HIDDEN_M = (0.0, 0.0, -50.0)

BACKGROUND, ARM, FIRST_OBJECT = 0, 1, 2


@dataclass(frozen=True)
class Picture:
    """One frame; ids: 0 background, 1 arm, 2 + i object i.

    Attributes:
        rgb: (H, W, 3) uint8.
        segmentation: (H, W) uint8.
        depth: (H, W) float32, metres along the optical axis.
    """

    rgb: np.ndarray
    segmentation: np.ndarray
    depth: np.ndarray


class Renderer:
    """A server that only draws: bodies are posed, nothing moves by itself, so a picture depends on poses alone."""

    def __init__(self, camera: Camera, size_px: int, backend: Backend = "tiny") -> None:
        self.camera, self.size_px, self.backend = camera, size_px, backend
        self.bullet = Client()
        self._view, self._projection = camera.view_matrix(), camera.projection_matrix()
        self._arm_model = panda.arm_model()
        self._arm = self.bullet.call("loadURDF", str(self._arm_model.visual), [0, 0, 0], useFixedBase=True)
        self._background()
        self._bodies: dict[Path, list[int]] = {}
        self._shown: list[int] = []
        self._models: list[ObjectModel] = []

    def _background(self) -> None:
        bullet = self.bullet
        low, high = np.array(world.TABLE_LOW_M), np.array(world.TABLE_HIGH_M)
        half = [*((high - low) / 2).tolist(), world.TABLE_THICKNESS_M / 2]
        place = [*((high + low) / 2).tolist(), -world.TABLE_THICKNESS_M / 2]
        shape = bullet.call(
            "createVisualShape", bullet.module.GEOM_BOX, halfExtents=half, rgbaColor=[0.6, 0.45, 0.3, 1]
        )
        bullet.call("createMultiBody", 0.0, -1, shape, place)
        shape = bullet.call(
            "createVisualShape", bullet.module.GEOM_BOX, halfExtents=[4, 4, 0.01], rgbaColor=[0.5, 0.5, 0.52, 1]
        )
        bullet.call("createMultiBody", 0.0, -1, shape, [0, 0, world.FLOOR_Z_M])

    def show(self, models: list[ObjectModel]) -> None:
        """Choose the scene's objects; object i of every later pose array is `models[i]`."""
        for body in self._shown:
            self._pose(body, np.array([*HIDDEN_M, 0, 0, 0, 1.0]))
        used: dict[Path, int] = {}
        self._shown = []
        for model in models:
            bodies = self._bodies.setdefault(model.visual, [])
            copy = used.get(model.visual, 0)
            if copy == len(bodies):
                bodies.append(self._load(model))
            used[model.visual] = copy + 1
            self._shown.append(bodies[copy])
        self._models = models

    def _load(self, model: ObjectModel) -> int:
        bullet = self.bullet
        shape = bullet.call("createVisualShape", bullet.module.GEOM_MESH, fileName=str(model.visual))
        return int(bullet.call("createMultiBody", 0.0, -1, shape, HIDDEN_M))

    def _pose(self, body: int, pose: np.ndarray) -> None:
        self.bullet.call("resetBasePositionAndOrientation", body, pose[:3].tolist(), pose[3:].tolist())

    def picture(self, joints: np.ndarray, poses: np.ndarray) -> Picture:
        """Draw the arm in joint positions (9,) and the shown objects at poses (O, 7)."""
        self._set_arm(joints)
        for body, pose in zip(self._shown, poses, strict=True):
            self._pose(body, pose)
        return self._draw()

    def _set_arm(self, joints: np.ndarray) -> None:
        for joint, value in zip(panda.JOINTS, joints.tolist(), strict=True):
            self.bullet.call("resetJointState", self._arm, joint, value)

    def _draw(self) -> Picture:
        bullet, size = self.bullet, self.size_px
        _, _, rgba, buffer, bodies = bullet.call(
            "getCameraImage",
            size,
            size,
            self._view,
            self._projection,
            lightDirection=[0.6, 0.4, 1.5],
            lightColor=[1, 1, 1],
            lightAmbientCoeff=0.55,
            lightDiffuseCoeff=0.5,
            lightSpecularCoeff=0.05,
            shadow=1,
            renderer=bullet.module.ER_TINY_RENDERER,
        )
        bodies = np.asarray(bodies).reshape(size, size)
        segmentation = np.zeros((size, size), dtype=np.uint8)
        segmentation[bodies == self._arm] = ARM
        for i, body in enumerate(self._shown):
            segmentation[bodies == body] = FIRST_OBJECT + i
        rgb = np.asarray(rgba, dtype=np.uint8).reshape(size, size, 4)[..., :3]
        depth = self.camera.metres(np.asarray(buffer, dtype=np.float32).reshape(size, size).astype(np.float64))
        return Picture(np.ascontiguousarray(rgb), segmentation, depth.astype(np.float32))

    def amodal_px(self, joints: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """(O + 1,) int32: pixels that the arm and each object cover before the empty table."""
        hidden = np.array([*HIDDEN_M, 0, 0, 0, 1.0])
        counts = np.zeros(len(poses) + 1, dtype=np.int32)
        for body in self._shown:
            self._pose(body, hidden)
        counts[0] = int((self._draw().segmentation == ARM).sum())
        self.bullet.call("resetBasePositionAndOrientation", self._arm, HIDDEN_M, [0, 0, 0, 1])
        for i, (body, pose) in enumerate(zip(self._shown, poses, strict=True)):
            self._pose(body, pose)
            counts[1 + i] = int((self._draw().segmentation == FIRST_OBJECT + i).sum())
            self._pose(body, hidden)
        self.bullet.call("resetBasePositionAndOrientation", self._arm, [0, 0, 0], [0, 0, 0, 1])
        return counts


def check_backend(backend: str) -> None:
    """Refuse a renderer that this machine lacks."""
    if backend not in ("tiny", "egl"):
        raise SimError(f"renderer {backend!r} is unknown: use 'tiny' or 'egl'.")
