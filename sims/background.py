"""The static background: a wooden table in a plain room, ray-cast once per camera, with exact depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sims.camera import Camera

TABLE_LOW_M = (-0.35, -0.6)
TABLE_HIGH_M = (1.25, 0.9)
"""The table's top lies at z = 0, the robot's base stands on it at the origin."""
TABLE_THICKNESS_M = 0.04
FLOOR_Z_M = -0.75
CEILING_Z_M = 2.5
WALL_M = 2.5
"""Distance of the four walls from the robot."""

RAYS = 4
"""Rays per pixel and axis for the colours; depth is taken at the pixel centre."""
PLANK_M = 0.13
WOOD = np.array([158.0, 132.0, 104.0])
EDGE = np.array([96.0, 76.0, 58.0])
FLOOR = np.array([112.0, 116.0, 122.0])
WALL = np.array([186.0, 190.0, 192.0])


@dataclass(frozen=True)
class Background:
    """The empty scene.

    Attributes:
        rgb: (H, W, 3) float32 in [0, 255].
        depth: (H, W) float64, metres along the optical axis.
        points: (H, W, 3) metres, the world point seen at each pixel centre.
        table: (H, W) bool, True where the table top is visible.
    """

    rgb: np.ndarray
    depth: np.ndarray
    points: np.ndarray
    table: np.ndarray


def background(camera: Camera, size_px: int) -> Background:
    """Render the empty scene for a camera."""
    fine = size_px * RAYS
    directions = _rays(camera, size_px, fine)
    origin = np.asarray(camera.eye)
    points, _, surface = _cast(origin, directions)
    rgb = _colours(points, surface).reshape(size_px, RAYS, size_px, RAYS, 3).mean(axis=(1, 3))
    points, reach, surface = _cast(origin, _rays(camera, size_px, size_px))
    return Background(rgb.astype(np.float32), reach, points, surface == 0)


def _rays(camera: Camera, size_px: int, count: int) -> np.ndarray:
    """(count, count, 3) directions whose length is one metre along the optical axis."""
    middle = (np.arange(count) + 0.5) * size_px / count
    column, row = np.meshgrid(middle, middle)
    pixels = np.stack([column, row, np.ones_like(row)], axis=-1)
    return pixels @ np.linalg.inv(camera.intrinsics(size_px)).T @ camera.extrinsics()[:3, :3]


def _cast(origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First hit of each ray: point, depth in metres, surface (0 table top, 1 its edge, 2 floor, 3 wall, 4 ceiling)."""
    with np.errstate(divide="ignore"):
        inverse = 1 / directions
    room_low, room_high = np.array([-WALL_M, -WALL_M, FLOOR_Z_M]), np.array([WALL_M, WALL_M, CEILING_Z_M])
    leave = np.maximum((room_low - origin) * inverse, (room_high - origin) * inverse)
    axis = np.argmin(leave, axis=-1)
    depth = leave.min(axis=-1)
    surface = np.where(axis < 2, 3, np.where(directions[..., 2] < 0, 2, 4))
    low = np.array([*TABLE_LOW_M, -TABLE_THICKNESS_M])
    high = np.array([*TABLE_HIGH_M, 0.0])
    one, two = (low - origin) * inverse, (high - origin) * inverse
    enter, exit_ = np.minimum(one, two), np.maximum(one, two)
    first = enter.max(axis=-1)
    hit = (first <= exit_.min(axis=-1)) & (first > 0)
    depth = np.where(hit, first, depth)
    top = hit & (np.argmax(enter, axis=-1) == 2) & (directions[..., 2] < 0)
    surface = np.where(top, 0, np.where(hit, 1, surface))
    return origin + depth[..., None] * directions, depth, surface


def _colours(points: np.ndarray, surface: np.ndarray) -> np.ndarray:
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    shade = 1 + 0.10 * np.exp(-((x - 0.5) ** 2 + y**2) / 0.25) - 0.05
    wood = _wood(x, y) * shade[..., None]
    floor = FLOOR * (0.93 + 0.07 * _noise(x * 3, y * 3, 5)[..., None])
    wall = WALL * (0.9 + 0.1 * np.clip((z - FLOOR_Z_M) / 2, 0, 1))[..., None]
    palette = [wood, np.broadcast_to(EDGE, wood.shape), floor, wall, np.broadcast_to(WALL, wood.shape)]
    return np.select([(surface == i)[..., None] for i in range(5)], palette)


def _wood(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Planks along y, each with its own tone and grain."""
    across = x / PLANK_M
    plank = np.floor(across)
    within = across - plank
    tone = np.random.default_rng(11).uniform(-1, 1, 64)[plank.astype(int) % 64]
    shift = plank * 7.31
    wave = 0.35 * _noise(y * 2.3 + shift, x * 9 + shift, 1)
    rings = np.sin(2 * np.pi * (x * 26 + 2.2 * wave + tone * 3))
    fibre = _noise(y * 6 + shift, x * 190, 2)
    light = 1 + 0.05 * tone + 0.03 * rings + 0.05 * (fibre - 0.5)
    seam = np.exp(-((np.minimum(within, 1 - within) * PLANK_M / 0.0016) ** 2))
    return WOOD * (light * (1 - 0.35 * seam))[..., None] + np.array([3.0, 0.0, -3.0]) * tone[..., None]


def _noise(u: np.ndarray, v: np.ndarray, seed: int) -> np.ndarray:
    """Smooth noise in [0, 1] with one independent value per unit square's corner."""
    table = np.random.default_rng(seed).uniform(size=(256, 256))
    i, j = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = u - i, v - j
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)

    def corner(di: int, dj: int) -> np.ndarray:
        return table[(i + di) % 256, (j + dj) % 256]

    near = corner(0, 0) * (1 - a) + corner(1, 0) * a
    far = corner(0, 1) * (1 - a) + corner(1, 1) * a
    return near * (1 - b) + far * b
