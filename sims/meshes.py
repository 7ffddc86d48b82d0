"""Mesh processing: object frames, decimation, normals, collision hulls, OBJ files."""

from __future__ import annotations

import itertools
from pathlib import Path

import fast_simplification
import numpy as np
import trimesh

CREASE_RAD = np.radians(40.0)
"""Faces that meet at a sharper angle than this are shaded with an edge between them."""


def object_frame(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh in its object frame: origin at the centre of the bounding box, z as scanned, x along the longer side.

    The scans have z up and an arbitrary yaw; the frame's horizontal axes are those of the minimum-area rectangle around
    the outline.
    """
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    outline = trimesh.convex.hull_points(vertices[:, :2])
    angles = np.linspace(0, np.pi / 2, 180, endpoint=False)
    spans = [np.ptp(outline @ _rotation2(angle).T, axis=0) for angle in angles]
    best = int(np.argmin([span[0] * span[1] for span in spans]))
    angle = angles[best] + (np.pi / 2 if spans[best][0] < spans[best][1] else 0.0)
    turned = vertices.copy()
    turned[:, :2] = vertices[:, :2] @ _rotation2(angle).T
    turned -= (turned.min(axis=0) + turned.max(axis=0)) / 2
    result = mesh.copy()
    result.vertices = turned
    return result


def _rotation2(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def decimate(mesh: trimesh.Trimesh, faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and triangles (F, 3) of a copy with about `faces` triangles (quadric edge collapse)."""
    welded = trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), process=False)
    welded.merge_vertices(merge_tex=True, merge_norm=True)
    vertices, triangles = np.asarray(welded.vertices), np.asarray(welded.faces)
    if len(triangles) > faces:
        vertices, triangles = fast_simplification.simplify(
            vertices.astype(np.float32), triangles.astype(np.int32), target_count=faces
        )
    vertices = np.asarray(vertices, dtype=np.float64)
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    solid = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-12
    return vertices, np.asarray(triangles, dtype=np.int64)[solid]


def corner_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(F, 3, 3): a normal per triangle corner, smooth over neighbours that meet at less than `CREASE_RAD`."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    area_normals = np.cross(b - a, c - a)
    units = area_normals / np.linalg.norm(area_normals, axis=1, keepdims=True)
    around: list[list[int]] = [[] for _ in vertices]
    for face, corners in enumerate(triangles):
        for vertex in corners:
            around[vertex].append(face)
    normals = np.empty((len(triangles), 3, 3))
    for face, corners in enumerate(triangles):
        for corner, vertex in enumerate(corners):
            neighbours = np.array(around[vertex])
            smooth = neighbours[units[neighbours] @ units[face] > np.cos(CREASE_RAD)]
            total = area_normals[smooth].sum(axis=0)
            normals[face, corner] = total / np.linalg.norm(total)
    return normals


def hull_vertices(points: np.ndarray, directions: int = 100) -> np.ndarray:
    """(N, 3): the extreme points of a cloud in evenly spread directions; an approximate convex hull for contacts."""
    index = np.arange(directions) + 0.5
    height = 1 - 2 * index / directions
    turn = np.pi * (1 + 5**0.5) * index
    radius = np.sqrt(1 - height**2)
    rays = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    extreme = np.unique(np.argmax(points @ np.concatenate([rays, axes]).T, axis=0))
    return points[extreme]


def dense_points(mesh: trimesh.Trimesh) -> np.ndarray:
    """(N, 3): vertices of a mesh subdivided until no edge is longer than a thirtieth of its largest extent."""
    longest = float(np.ptp(np.asarray(mesh.vertices), axis=0).max()) / 30
    vertices, _ = trimesh.remesh.subdivide_to_size(np.asarray(mesh.vertices), np.asarray(mesh.faces), longest, 20)[:2]
    return np.unique(np.round(vertices, 6), axis=0)


def convex_parts(points: np.ndarray, name: str, convex: bool) -> list[np.ndarray]:
    """Vertex clouds whose convex hulls form the collision body.

    A non-convex shape is sliced across its longest horizontal side (banana); the mug is split into its cup, solid for
    contacts, and its handle.
    """
    if convex:
        return [hull_vertices(points)]
    if name == "mug":
        centre, radius = _cup(points)
        outside = np.linalg.norm(points[:, :2] - centre, axis=1) > radius * 1.03
        edges = np.quantile(points[outside, 2], [0, 1 / 3, 2 / 3, 1])
        handle = [
            points[outside & (points[:, 2] >= low) & (points[:, 2] <= high)] for low, high in itertools.pairwise(edges)
        ]
        return [hull_vertices(points[~outside]), *(hull_vertices(part, 60) for part in handle)]
    edges = np.linspace(points[:, 0].min(), points[:, 0].max(), 7)
    overlap = (edges[1] - edges[0]) * 0.05
    parts = []
    for low, high in itertools.pairwise(edges):
        slice_ = points[(points[:, 0] >= low - overlap) & (points[:, 0] <= high + overlap)]
        if len(slice_) >= 4:
            parts.append(hull_vertices(slice_, 80))
    return parts


def _cup(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (2,) and radius of a mug's cup, from a circle fit to its base."""
    low = points[points[:, 2] < np.quantile(points[:, 2], 0.05)][:, :2]
    outline = trimesh.convex.hull_points(low)
    system = np.column_stack([2 * outline, np.ones(len(outline))])
    solution = np.linalg.lstsq(system, (outline**2).sum(axis=1), rcond=None)[0]
    base = float(np.sqrt(solution[2] + solution[0] ** 2 + solution[1] ** 2))
    distance = np.linalg.norm(points[:, :2] - solution[:2], axis=1)
    return solution[:2], max(base, float(np.median(distance)))


def write_obj(
    path: Path,
    vertices: np.ndarray,
    triangles: np.ndarray,
    normals: np.ndarray,
    uv: np.ndarray,
    texture: str,
) -> None:
    """Write a textured OBJ and its MTL.

    Args:
        path: the OBJ file; the MTL gets the same stem.
        vertices: (V, 3) metres.
        triangles: (F, 3).
        normals: (F, 3, 3) per corner.
        uv: (F, 3, 2) per corner in [0, 1], v upwards.
        texture: file name of the image beside the OBJ.
    """
    lines = [f"mtllib {path.stem}.mtl", "o object"]
    lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in uv.reshape(-1, 2)]
    lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in normals.reshape(-1, 3)]
    lines.append("usemtl drawn")
    for face, corners in enumerate(triangles):
        words = [f"{vertex + 1}/{3 * face + i + 1}/{3 * face + i + 1}" for i, vertex in enumerate(corners)]
        lines.append("f " + " ".join(words))
    path.write_text("\n".join(lines) + "\n")
    path.with_suffix(".mtl").write_text(f"newmtl drawn\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nd 1\nillum 1\nmap_Kd {texture}\n")


def write_hulls(path: Path, parts: list[np.ndarray]) -> None:
    """Write convex parts as one OBJ with one group per part, which PyBullet loads as a compound of hulls."""
    lines: list[str] = []
    first = 1
    for number, part in enumerate(parts):
        hull = trimesh.convex.convex_hull(part)
        lines.append(f"o part{number}")
        lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in hull.vertices]
        lines += ["f " + " ".join(str(first + i) for i in corners) for corners in hull.faces]
        first += len(hull.vertices)
    path.write_text("\n".join(lines) + "\n")
