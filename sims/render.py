"""Rendering of a posed scene: colour, ids, depth, and amodal pixel counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sims import arm as panda
from sims import outlines
from sims.assets import ObjectModel
from sims.background import background
from sims.camera import Camera
from sims.poses import moved
from sims.stage import ARM_ID, FIRST_OBJECT_ID, HIDDEN_POSE, LIGHT_DIRECTION, Backend, Stage

SHADOW_STRENGTH = 0.3
LIGHT = (1 - SHADOW_STRENGTH * np.arange(256) / 255).astype(np.float32)
"""Factor on a pixel's colour, indexed by shadow in [0, 255]."""


@dataclass(frozen=True)
class Picture:
    """One frame; ids: 0 background, 1 arm, 2 + i object i.

    Attributes:
        rgb: (H, W, 3) uint8.
        segmentation: (H, W) uint8.
        depth: (H, W) float32, metres along the optical axis.
        amodal_px: (O + 1,) int32, pixels that the arm and each object cover when rendered alone on the table.
    """

    rgb: np.ndarray
    segmentation: np.ndarray
    depth: np.ndarray
    amodal_px: np.ndarray


@dataclass(frozen=True)
class _Layer:
    """Output of one stage where it is nearer than the empty table: colour, ids, depth (infinite elsewhere)."""

    rgb: np.ndarray
    ids: np.ndarray
    depth: np.ndarray


class Renderer:
    """Renders the arm and the objects at given poses on the table.

    A frame is composited by depth from three layers, which gives the same pixels as rendering everything at once: the
    empty table, rendered once (`background`); the objects, rendered again only when one has moved; and the arm. Each
    layer also gives amodal counts, since the other layers do not occlude it. Soft shadows fall on the table and belong
    to the background.
    """

    def __init__(self, camera: Camera, size_px: int, backend: Backend = "tiny") -> None:
        self.camera, self.size_px = camera, size_px
        self._empty = background(camera, size_px)
        arm = panda.arm_model()
        self._links = panda.Links(arm)
        self._arm_stage = Stage(backend, arm)
        # Hidden triangles cost time too, so the arm has a stage of its own; EGL has one image buffer per process.
        self._object_stage = Stage(backend, None) if backend == "tiny" else self._arm_stage
        self._models: tuple[ObjectModel, ...] = ()
        self._last_poses = b""
        self._last_objects: tuple[_Layer, np.ndarray] | None = None

    def show(self, models: tuple[ObjectModel, ...]) -> None:
        """Choose the scene's objects; object i of every later pose array is `models[i]`."""
        self._models, self._last_poses = models, b""
        self._object_stage.show(models)

    def picture(self, joints: np.ndarray, poses: np.ndarray) -> Picture:
        """Render the arm at joint positions (9,) and the chosen objects at poses (O, 7)."""
        arm = self._arm_layer(joints)
        links = self._links.points(self._arm_stage.bullet, self._arm_stage.arm)
        if self._last_objects is None or self._last_poses != poses.tobytes():
            self._last_objects, self._last_poses = self._object_layer(poses), poses.tobytes()
        objects, object_px = self._last_objects
        in_front = arm.depth < objects.depth
        ids = np.where(in_front, arm.ids, objects.ids)
        depth = np.where(ids > 0, np.minimum(arm.depth, objects.depth), self._empty.depth)
        rgb = self._table_with_shadows(links, poses)
        for layer, shown in ((arm, in_front), (objects, (ids > 0) & ~in_front)):
            rgb[shown] = layer.rgb[shown]
        amodal_px = np.array([np.count_nonzero(arm.ids), *object_px], dtype=np.int32)
        return Picture(rgb, ids, depth.astype(np.float32), amodal_px)

    def _arm_layer(self, joints: np.ndarray) -> _Layer:
        stage = self._arm_stage
        for body in stage.bodies:
            stage.pose(body, HIDDEN_POSE)
        stage.show_arm(True)
        stage.pose_joints(joints)
        return self._layer(stage)

    def _layer(self, stage: Stage) -> _Layer:
        rgb, depth, ids = stage.draw(self.camera, self.size_px)
        seen = (ids > 0) & (depth < self._empty.depth)
        return _Layer(rgb, np.where(seen, ids, 0).astype(np.uint8), np.where(seen, depth, np.inf))

    def _object_layer(self, poses: np.ndarray) -> tuple[_Layer, np.ndarray]:
        """The objects' layer, and the amodal pixel count of each object (O,)."""
        stage = self._object_stage
        stage.show_arm(False)
        for body, pose in zip(stage.bodies, poses, strict=True):
            stage.pose(body, pose)
        layer = self._layer(stage)
        counts = [np.count_nonzero(layer.ids == FIRST_OBJECT_ID + number) for number in range(len(poses))]
        for number in self._partly_hidden(layer, poses):
            for other, pose in enumerate(poses):
                stage.pose(stage.bodies[other], pose if other == number else HIDDEN_POSE)
            counts[number] = np.count_nonzero(self._layer(stage).ids)
        return layer, np.array(counts, dtype=np.int32)

    def _partly_hidden(self, layer: _Layer, poses: np.ndarray) -> list[int]:
        """Objects that another object may occlude.

        An object is not occluded when no pixel of another object is both within the outline of its vertices and nearer
        than its farthest vertex.
        """
        found = []
        for number, (model, pose) in enumerate(zip(self._models, poses, strict=True)):
            others = (layer.ids > 0) & (layer.ids != FIRST_OBJECT_ID + number)
            if others.any():
                reach, far = outlines.cover(self.camera, self.size_px, moved(model.vertices, pose))
                if (others & reach & (layer.depth < far)).any():
                    found.append(number)
        return found

    def _table_with_shadows(self, links: list[np.ndarray], poses: np.ndarray) -> np.ndarray:
        bodies = list(links)
        for model, pose in zip(self._models, poses, strict=True):
            bodies += [moved(part, pose) for part in model.parts]
        dark = outlines.shadows(self.camera, self.size_px, bodies, np.array(LIGHT_DIRECTION))
        light = LIGHT[dark * self._empty.table]
        return np.rint(self._empty.rgb * light[..., None]).astype(np.uint8)

    def close(self) -> None:
        """Free the servers."""
        self._arm_stage.close()
        self._object_stage.close()


__all__ = ["ARM_ID", "FIRST_OBJECT_ID", "Picture", "Renderer"]
