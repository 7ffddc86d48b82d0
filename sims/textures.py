"""Texture layout of the scans: tiles of the texture, and texture coordinates by box or cylinder projection.

| projection | texture (width : height = 3 : 2) | triangles |
|---|---|---|
| box | six tiles, 3 x 2: front, back, top / right, left, bottom | by the largest component of the normal |
| can | a strip around z over three tiles: top, bottom, inside | caps, hollow and the rest |
| round | one strip around z, height = polar angle from the top | all |
| length | one strip around x, height = position along x | all |

The front faces -y, as the object frame's x axis runs along the longer side. Strips repeat a little at both ends, so
no triangle crosses the seam.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

Projection = Literal["box", "can", "round", "length"]

WRAP = 0.12
"""Share of a turn that a strip repeats at each end."""
STRIP_HEIGHT = 0.68
"""Share of a can's texture used by the strip; the tiles of its caps use the rest."""
INSET = 0.012
"""Margin at a tile's border, as a share of the texture, so that neighbouring tiles never bleed in."""
CAP_COSINE = 0.8

BOX_TILES = ("front", "back", "top", "right", "left", "bottom")


def texture_coordinates(vertices: np.ndarray, triangles: np.ndarray, projection: Projection) -> np.ndarray:
    """Texture coordinates per corner (F, 3, 2) in [0, 1], v upwards, of a mesh in its object frame.

    Args:
        vertices: (V, 3) metres.
        triangles: (F, 3).
        projection: one of the table above.
    """
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    unit = (corners - low) / (high - low)
    if projection == "box":
        return _box(unit, normals)
    if projection == "can":
        return _can(corners, unit, normals, (low + high) / 2)
    if projection == "round":
        centred = corners - (low + high) / 2
        height = 1 - np.arccos(np.clip(centred[..., 2] / np.linalg.norm(centred, axis=-1), -1, 1)) / np.pi
        return _strip(np.arctan2(centred[..., 1], centred[..., 0]), height, 0.0)
    centred = corners - (low + high) / 2
    return _strip(np.arctan2(centred[..., 2], centred[..., 1]), unit[..., 0], 0.0)


def _box(unit: np.ndarray, normals: np.ndarray) -> np.ndarray:
    axis = np.argmax(np.abs(normals), axis=1)
    forward = normals[np.arange(len(normals)), axis] > 0
    x, y, z = unit[..., 0], unit[..., 1], unit[..., 2]
    seen = {
        "front": (x, z, (axis == 1) & ~forward),
        "back": (1 - x, z, (axis == 1) & forward),
        "right": (y, z, (axis == 0) & forward),
        "left": (1 - y, z, (axis == 0) & ~forward),
        "top": (x, y, (axis == 2) & forward),
        "bottom": (x, 1 - y, (axis == 2) & ~forward),
    }
    uv = np.empty((len(unit), 3, 2))
    for number, name in enumerate(BOX_TILES):
        across, up, chosen = seen[name]
        column, row = number % 3, number // 3
        uv[chosen, :, 0] = _into(across[chosen], column / 3, (column + 1) / 3)
        uv[chosen, :, 1] = _into(up[chosen], 0.5 - row / 2, 1 - row / 2)
    return uv


def _can(corners: np.ndarray, unit: np.ndarray, normals: np.ndarray, centre: np.ndarray) -> np.ndarray:
    radial = corners.mean(axis=1)[:, :2] - centre[:2]
    inward = (radial * normals[:, :2]).sum(axis=1) < -0.3 * np.linalg.norm(radial, axis=1)
    middle = unit.mean(axis=1)
    top = (normals[:, 2] > CAP_COSINE) & (middle[:, 2] > 0.9)
    bottom = (normals[:, 2] < -CAP_COSINE) & (middle[:, 2] < 0.1)
    hollow = (inward | (normals[:, 2] > CAP_COSINE)) & (np.abs(middle[:, :2] - 0.5).max(axis=1) < 0.45) & ~top
    uv = _strip(np.arctan2(corners[..., 1] - centre[1], corners[..., 0] - centre[0]), unit[..., 2], 1 - STRIP_HEIGHT)
    for number, chosen in enumerate((top, bottom, hollow)):  # tiles in this order
        uv[chosen, :, 0] = _into(unit[chosen][..., 0], number / 3, (number + 1) / 3)
        uv[chosen, :, 1] = _into(unit[chosen][..., 1], 0.0, 1 - STRIP_HEIGHT)
    return uv


def _strip(angle: np.ndarray, height: np.ndarray, floor: float) -> np.ndarray:
    """Coordinates on a strip from `floor` to the top; the front (-y; for `length`, below) is in the middle."""
    turn = (angle / (2 * np.pi) + 0.75) % 1.0
    middle = turn[:, :1]
    turn = middle + (turn - middle + 0.5) % 1.0 - 0.5
    across = np.clip((turn + WRAP) / (1 + 2 * WRAP), 0, 1)
    return np.stack([_into(across, 0, 1), _into(height, floor, 1)], axis=-1)


def _into(share: np.ndarray, low: float, high: float) -> np.ndarray:
    return low + INSET + share * (high - low - 2 * INSET)
