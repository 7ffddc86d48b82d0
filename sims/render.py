"""Pictures of a posed scene: colour, ids and depth from one draw, and what each body covers when it stands alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import ndimage

from sims import arm as panda
from sims.assets import ObjectModel
from sims.background import TABLE_HIGH_M, TABLE_LOW_M, background
from sims.bullet import Client
from sims.camera import Camera

Backend = Literal["tiny", "egl"]

BACKGROUND_ID, ARM_ID, FIRST_OBJECT_ID = 0, 1, 2
HIDDEN_POSE = np.array([0.0, 0.0, -50.0, 0.0, 0.0, 0.0, 1.0])

LIGHT_DIRECTION = (0.35, -0.5, 1.0)
AMBIENT, DIFFUSE, SPECULAR = 0.58, 0.52, 0.04
SHADOW_SIZE_PX = 96
SHADOW_BLUR_PX = 1.0
SHADOW_STRENGTH = 0.3
SUN = Camera(
    eye=tuple(float(0.5 * (axis == 0) + 3.0 * LIGHT_DIRECTION[axis]) for axis in range(3)),  # type: ignore[arg-type]
    target=(0.5, 0.0, 0.0),
    fov_deg=22.0,
    near_m=0.5,
    far_m=6.0,
)
"""The light seen as a camera: what it sees of arm and objects keeps the light from the table."""


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
    """A server that only draws: bodies are posed, nothing moves by itself, so a picture depends on poses alone.

    The empty table never changes, so it is drawn once (`background`); per frame only arm and objects are drawn, and
    each of their pixels stands where it is nearer than the background: the picture, its ids and its depth are the same
    as from one draw of everything, at a fraction of the cost. Soft shadows fall on the table; they belong to the
    background.
    """

    def __init__(self, camera: Camera, size_px: int, backend: Backend = "tiny") -> None:
        self.camera, self.size_px, self.backend = camera, size_px, backend
        self.bullet = Client()
        self._empty = background(camera, size_px)
        self._shadow_lookup = _shadow_lookup(self._empty.points)
        self._arm_model = panda.arm_model()
        self._arm = self.bullet.call("loadURDF", str(self._arm_model.visual), [0, 0, 0], useFixedBase=True)
        self._bodies: list[int] = []
        self._models: tuple[ObjectModel, ...] = ()
        self._amodal_seen: dict[tuple[int, bytes], int] = {}

    def show(self, models: tuple[ObjectModel, ...]) -> None:
        """Choose the scene's objects; object i of every later pose array is `models[i]`."""
        for body in self._bodies:
            self.bullet.call("removeBody", body)
        self._bodies = [self._load(model) for model in models]
        self._models = models
        self._amodal_seen = {}

    def _load(self, model: ObjectModel) -> int:
        mesh = self.bullet.module.GEOM_MESH
        shape = self.bullet.call("createVisualShape", mesh, fileName=str(model.visual))
        return int(self.bullet.call("createMultiBody", 0.0, -1, shape, HIDDEN_POSE[:3].tolist()))

    def picture(self, joints: np.ndarray, poses: np.ndarray) -> Picture:
        """Draw the arm in joint positions (9,) and the shown objects at poses (O, 7)."""
        for joint, value in zip(panda.JOINTS, joints.tolist(), strict=True):
            self.bullet.call("resetJointState", self._arm, joint, value)
        for body, pose in zip(self._bodies, poses, strict=True):
            self._pose(body, pose)
        rgb, depth, segmentation = self._draw(self.camera, self.size_px)
        front = (segmentation > 0) & (depth < self._empty.depth)
        empty = self._empty.rgb * (1 - SHADOW_STRENGTH * self._shadow()[..., None])
        return Picture(
            np.where(front[..., None], rgb, np.clip(np.rint(empty), 0, 255).astype(np.uint8)),
            np.where(front, segmentation, 0).astype(np.uint8),
            np.where(front, depth, self._empty.depth).astype(np.float32),
        )

    def amodal_px(self, joints: np.ndarray, poses: np.ndarray, picture: Picture) -> np.ndarray:
        """(O + 1,) int32: pixels that the arm and each object cover when they stand alone on the table.

        Only who may have something in front is drawn again: a body is whole when, within the bounds of its projected
        bounding boxes, no pixel of another body is nearer than the box's far end.

        Args:
            joints, poses: as for `picture`, which must have been called with them just before.
            picture: its result.
        """
        counts = np.zeros(len(poses) + 1, dtype=np.int32)
        for part, boxes in enumerate([self._arm_boxes(), *self._object_boxes(poses)]):
            visible = picture.segmentation == part + 1
            if self._may_be_hidden(boxes, picture, visible):
                counts[part] = self._alone(part, poses)
            else:
                counts[part] = np.count_nonzero(visible)
        return counts

    def _pose(self, body: int, pose: np.ndarray) -> None:
        self.bullet.call("resetBasePositionAndOrientation", body, pose[:3].tolist(), pose[3:].tolist())

    def _draw(self, camera: Camera, size_px: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Arm and objects over nothing: rgb (H, W, 3), depth (H, W) in metres, ids (H, W)."""
        module: Any = self.bullet.module
        _, _, rgba, buffer, bodies = self.bullet.call(
            "getCameraImage",
            size_px,
            size_px,
            camera.view_matrix(),
            camera.projection_matrix(),
            lightDirection=LIGHT_DIRECTION,
            lightColor=[1, 1, 1],
            lightAmbientCoeff=AMBIENT,
            lightDiffuseCoeff=DIFFUSE,
            lightSpecularCoeff=SPECULAR,
            shadow=0,
            renderer=module.ER_TINY_RENDERER,
        )
        bodies = np.reshape(bodies, (size_px, size_px))
        ids = np.zeros(bodies.shape, dtype=np.uint8)
        ids[bodies == self._arm] = ARM_ID
        for number, body in enumerate(self._bodies):
            ids[bodies == body] = FIRST_OBJECT_ID + number
        depth = camera.metres(np.reshape(buffer, bodies.shape).astype(np.float64))
        return np.reshape(rgba, (size_px, size_px, 4))[..., :3].astype(np.uint8), depth, ids

    def _shadow(self) -> np.ndarray:
        """(H, W) share of light that arm and objects keep from each pixel of the background, in [0, 1]."""
        _, _, ids = self._draw(SUN, SHADOW_SIZE_PX)
        blocked = ndimage.gaussian_filter((ids > 0).astype(np.float32), SHADOW_BLUR_PX, mode="constant").ravel()
        index, weight = self._shadow_lookup
        return (blocked[index] * weight).sum(axis=0)

    def _object_boxes(self, poses: np.ndarray) -> list[np.ndarray]:
        """(1, 8, 3) world corners of each object's bounding box."""
        boxes = []
        for model, pose in zip(self._models, poses, strict=True):
            boxes.append((model.corners @ rotation(pose[3:]).T + pose[:3])[None])
        return boxes

    def _arm_boxes(self) -> np.ndarray:
        """(L, 8, 3) world corners of the bounding boxes of all drawn links."""
        links = list(self._arm_model.boxes)
        moving = [link for link in links if link >= 0]
        states = self.bullet.call("getLinkStates", self._arm, moving, computeForwardKinematics=True)
        boxes = [self._arm_model.boxes[link] for link in links if link < 0]
        for link, state in zip(moving, states, strict=True):
            boxes.append(self._arm_model.boxes[link] @ rotation(np.array(state[5])).T + np.array(state[4]))
        return np.stack(boxes)

    def _may_be_hidden(self, boxes: np.ndarray, picture: Picture, visible: np.ndarray) -> bool:
        others = (picture.segmentation != BACKGROUND_ID) & ~visible
        pixels, depth = self.camera.project(boxes, self.size_px)
        for corners, far in zip(pixels, depth, strict=True):
            if far.min() < self.camera.near_m:
                inside = others
                near = picture.depth
            else:
                low = np.clip(np.floor(corners.min(axis=0)).astype(int) - 1, 0, self.size_px)
                high = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 1, 0, self.size_px)
                window = np.s_[low[1] : high[1], low[0] : high[0]]
                inside, near = others[window], picture.depth[window]
            if (inside & (near < far.max())).any():
                return True
        return False

    def _alone(self, part: int, poses: np.ndarray) -> int:
        """Pixels of the arm (0) or object `part - 1` with everything else out of sight."""
        key = (part, poses[part - 1].tobytes())
        if part > 0 and key in self._amodal_seen:
            return self._amodal_seen[key]
        for number, body in enumerate(self._bodies):
            if number != part - 1:
                self._pose(body, HIDDEN_POSE)
        if part > 0:
            self._pose(self._arm, HIDDEN_POSE)
        _, depth, ids = self._draw(self.camera, self.size_px)
        count = int(np.count_nonzero((ids > 0) & (depth < self._empty.depth)))
        for body, pose in zip(self._bodies, poses, strict=True):
            self._pose(body, pose)
        if part > 0:
            self._pose(self._arm, np.array([0, 0, 0, 0, 0, 0, 1.0]))
            self._amodal_seen[key] = count
        return count

    def close(self) -> None:
        """Free the server."""
        self.bullet.close()


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """(3, 3) matrix of a unit quaternion x, y, z, w."""
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _shadow_lookup(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where each background pixel lies in the light's picture: four flat indices and their bilinear weights.

    Only the table's top takes shadows (4, H, W); elsewhere the weights are zero.
    """
    pixels, depth = SUN.project(points, SHADOW_SIZE_PX)
    place = pixels - 0.5
    corner = np.floor(place).astype(int)
    inside = (corner >= 0).all(axis=-1) & (corner < SHADOW_SIZE_PX - 1).all(axis=-1) & (depth > 0)
    on_top = (np.abs(points[..., 2]) < 1e-6) & (points[..., :2] >= TABLE_LOW_M).all(axis=-1)
    on_top &= (points[..., :2] <= TABLE_HIGH_M).all(axis=-1)
    corner = np.where((inside & on_top)[..., None], corner, 0)
    a, b = np.moveaxis(place - corner, -1, 0)
    index = corner[..., 1] * SHADOW_SIZE_PX + corner[..., 0]
    indices = np.stack([index, index + 1, index + SHADOW_SIZE_PX, index + SHADOW_SIZE_PX + 1])
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    return indices, np.where(inside & on_top, weights, 0).astype(np.float32)
