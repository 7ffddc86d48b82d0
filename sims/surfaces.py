"""Watertight outer surfaces of models made of many shells, and texture baking from one surface to another."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy import ndimage
from scipy.spatial import cKDTree

BORDER_CELLS = 6
SAMPLES_PER_CELL = 8
OPENING_CELLS = 1
BLUR_CELLS = 1.2


def outer_surface(mesh: trimesh.Trimesh, cells: int = 128) -> trimesh.Trimesh:
    """A watertight, slightly rounded surface around a mesh, without its interior.

    CAD models consist of hundreds of open shells, which edge collapse tears apart. The mesh is voxelised on a grid of
    `cells` along its longest side; a cell is inside when it is occluded from at least five of the six axis directions
    (so that an opening on one side does not hollow the part), and the surface is the smoothed grid's level set.
    """
    points = np.asarray(mesh.vertices)
    pitch = float(np.ptp(points, axis=0).max()) / cells
    origin = points.min(axis=0) - BORDER_CELLS * pitch
    shape = np.ceil(np.ptp(points, axis=0) / pitch).astype(int) + 2 * BORDER_CELLS
    count = int(mesh.area / pitch**2 * SAMPLES_PER_CELL)
    samples, _ = trimesh.sample.sample_surface(mesh, count, seed=0)
    filled = np.zeros(shape, dtype=bool)
    filled[tuple(((samples - origin) / pitch).astype(int).T)] = True
    filled = ndimage.binary_closing(filled, iterations=2)
    hidden = np.zeros(shape, dtype=np.int8)
    for axis in range(3):
        hidden += np.logical_or.accumulate(filled, axis=axis)
        hidden += np.flip(np.logical_or.accumulate(np.flip(filled, axis), axis=axis), axis)
    solid = ndimage.binary_opening(hidden >= 5, iterations=OPENING_CELLS)
    field = ndimage.gaussian_filter(solid.astype(np.float32), BLUR_CELLS)
    vertices, triangles = level_set(field, 0.5)
    return trimesh.Trimesh((vertices + 0.5) * pitch + origin, triangles, process=False)


def level_set(field: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Surface nets (Gibson 1998): the surface where a sampled field (X, Y, Z) falls below a level.

    One vertex per crossed grid cell, at the mean of its edge crossings; two triangles, facing the lower side, per
    crossed grid edge. The field must stay below the level at the grid's border.

    Returns:
        Vertices (V, 3) in grid units and triangles (F, 3).
    """
    shape = tuple(side - 1 for side in field.shape)
    total, crossings = np.zeros((3, *shape)), np.zeros(shape)
    edges: list[tuple[list[np.ndarray], np.ndarray]] = []
    for axis in range(3):
        here, there = np.delete(field, -1, axis), np.delete(field, 0, axis)
        crossed = (here > level) != (there > level)
        corner = np.argwhere(crossed)
        position = corner.astype(np.float64)
        position[:, axis] += (level - here[crossed]) / (there[crossed] - here[crossed])
        around: list[np.ndarray] = []
        for step in ((0, 0), (-1, 0), (-1, -1), (0, -1)):
            cell = corner.copy()
            cell[:, (axis + 1) % 3] += step[0]
            cell[:, (axis + 2) % 3] += step[1]
            place = np.asarray(np.ravel_multi_index(tuple(cell.T), shape))
            crossings += np.bincount(place, minlength=crossings.size).reshape(shape)
            for i in range(3):
                total[i] += np.bincount(place, position[:, i], crossings.size).reshape(shape)
            around.append(place)
        edges.append((around, here[crossed] > level))
    passed = crossings > 0
    number = np.cumsum(passed).reshape(-1) - 1
    quads = []
    for around, outward in edges:
        quad = np.stack([number[place] for place in around], axis=1)
        quads.append(np.where(outward[:, None], quad, quad[:, ::-1]))
    quad = np.concatenate(quads)
    triangles = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    return (total[:, passed] / crossings[passed]).T, triangles


def transferred_normals(vertices: np.ndarray, triangles: np.ndarray, smooth: trimesh.Trimesh) -> np.ndarray:
    """(F, 3, 3): per corner of a coarse mesh, the normal of the fine smooth mesh nearest to it."""
    corners = vertices[triangles]
    inside = 0.97 * corners + 0.03 * corners.mean(axis=1, keepdims=True)
    nearest = cKDTree(smooth.vertices).query(inside.reshape(-1, 3))[1]
    return np.asarray(smooth.vertex_normals)[nearest].reshape(-1, 3, 3)


def bake(
    vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray, colours: np.ndarray, cell_px: int
) -> tuple[np.ndarray, np.ndarray]:
    """Bake the colours of a point cloud on (nearly) the same surface into a texture for a mesh.

    Each square cell of the texture holds two triangles; every texel takes the colour of the point nearest to its
    position on the mesh.

    Args:
        vertices: (V, 3); triangles: (F, 3).
        points: (N, 3) with colours (N, 3) uint8.
        cell_px: side of a cell.

    Returns:
        Texture (S, S, 3) uint8 and texture coordinates (F, 3, 2) in [0, 1], v upwards.
    """
    columns = int(np.ceil(np.sqrt((len(triangles) + 1) // 2)))
    size = columns * cell_px
    face = np.arange(len(triangles))
    corner = np.stack([face // 2 % columns, face // 2 // columns], axis=1) * cell_px
    upper = face % 2 == 1
    last = cell_px - 1
    # Texel centres of the triangle's corners within its cell: the halves meet along the cell's diagonal.
    lower_px = np.array([[0, 0], [last - 1, 0], [0, last - 1]])
    upper_px = np.array([[last, last], [1, last], [last, 1]])
    texels = corner[:, None] + np.where(upper[:, None, None], upper_px, lower_px)
    row, column = np.mgrid[0:cell_px, 0:cell_px]
    along, across = column / (last - 1), row / (last - 1)
    below = column + row < cell_px
    picture = np.zeros((size, size, 3), dtype=np.uint8)
    tree = cKDTree(points)
    for half in (False, True):
        chosen = face[upper == half]
        inside = ~below if half else below
        s = (last - column[inside]) / (last - 1) if half else along[inside]
        t = (last - row[inside]) / (last - 1) if half else across[inside]
        a, b, c = (vertices[triangles[chosen, i]][:, None] for i in range(3))
        place = a + s[None, :, None] * (b - a) + t[None, :, None] * (c - a)
        colour = colours[tree.query(place.reshape(-1, 3))[1]].reshape(*place.shape[:2], 3)
        rows = corner[chosen, 1][:, None] + row[inside]
        picture[rows, corner[chosen, 0][:, None] + column[inside]] = colour
    uv = (texels + 0.5) / size
    uv[..., 1] = 1 - uv[..., 1]
    return picture, uv
