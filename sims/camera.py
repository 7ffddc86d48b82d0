"""A pinhole camera: OpenGL matrices for renderers, intrinsics and extrinsics for projecting points."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

Vector = Annotated[tuple[float, float, float], Field(strict=False)]


class Camera(BaseModel):
    """Position, target and field of view of the camera; world frame in metres, z up, robot base at the origin."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    eye: Vector = (0.52, -0.92, 0.5)
    target: Vector = (0.52, -0.05, 0.0)
    fov_deg: float = Field(default=27.0, gt=1, lt=150)
    """Vertical field of view; images are square."""
    near_m: float = Field(default=0.1, gt=0)
    far_m: float = Field(default=4.0, gt=0)

    @model_validator(mode="after")
    def _check(self) -> Camera:
        if self.far_m <= self.near_m:
            raise ValueError(f"camera.far_m {self.far_m} must be greater than camera.near_m {self.near_m}")
        gaze = np.subtract(self.target, self.eye)
        if np.hypot(gaze[0], gaze[1]) < 1e-6:
            raise ValueError(f"camera.eye {self.eye} must not be vertically above or below camera.target {self.target}")
        return self

    def intrinsics(self, size_px: int) -> np.ndarray:
        """(3, 3) float64: pixel = K @ point_in_camera / depth, with pixel centres at integer + 0.5."""
        focal = size_px / 2 / np.tan(np.radians(self.fov_deg) / 2)
        return np.array([[focal, 0, size_px / 2], [0, focal, size_px / 2], [0, 0, 1.0]])

    def extrinsics(self) -> np.ndarray:
        """(4, 4) float64: world to camera; camera axes x right, y down, z forward (the OpenCV convention)."""
        return _extrinsics(self.eye, self.target).copy()

    def project(self, points: np.ndarray, size_px: int) -> tuple[np.ndarray, np.ndarray]:
        """World points (..., 3) in metres to pixels (..., 2) as (column, row) and depth (...) in metres."""
        world_to_camera = _extrinsics(self.eye, self.target)
        camera_points = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
        depth = camera_points[..., 2]
        pixels = camera_points @ self.intrinsics(size_px).T
        return pixels[..., :2] / depth[..., None], depth

    def view_matrix(self) -> list[float]:
        """OpenGL's world-to-eye matrix, 16 numbers column by column."""
        return (np.diag([1.0, -1.0, -1.0, 1.0]) @ self.extrinsics()).T.ravel().tolist()

    def projection_matrix(self) -> list[float]:
        """OpenGL's perspective matrix, 16 numbers column by column."""
        near, far = self.near_m, self.far_m
        focal = 1 / np.tan(np.radians(self.fov_deg) / 2)
        matrix = np.zeros((4, 4))
        matrix[0, 0] = matrix[1, 1] = focal
        matrix[2, 2] = -(far + near) / (far - near)
        matrix[2, 3] = -2 * far * near / (far - near)
        matrix[3, 2] = -1
        return matrix.T.ravel().tolist()

    def metres(self, depth_buffer: np.ndarray) -> np.ndarray:
        """A depth buffer in [0, 1] as metres along the optical axis."""
        near, far = self.near_m, self.far_m
        return near * far / (far - (far - near) * depth_buffer)


@lru_cache(maxsize=16)
def _extrinsics(eye: Vector, target: Vector) -> np.ndarray:
    forward = np.subtract(target, eye)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ np.asarray(eye)
    return matrix
