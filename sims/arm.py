"""The Panda arm: PyBullet's own model, redrawn with few faces, and the way it follows a straight line."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from sims import meshes
from sims.assets import file_hash, made_once
from sims.bullet import load_pybullet_data

FACE_SHARE = 0.05
"""Faces kept of the visual meshes (101,735 in all)."""

JOINTS = (0, 1, 2, 3, 4, 5, 6, 9, 10)
"""PyBullet's indices of the seven arm joints and the two fingers."""
HAND_LINK = 8
GRASP_LINK = 11
"""The point between the fingertips, 0.105 m from the hand's flange."""
REST_RAD = (0.0, 0.3, 0.0, -2.2, 0.0, 2.5, 0.785)
LOWER_RAD = (-2.9671, -1.8326, -2.9671, -3.1416, -2.9671, -0.0873, -2.9671)
UPPER_RAD = (2.9671, 1.8326, 2.9671, 0.0, 2.9671, 3.8223, 2.9671)
FORCE_N = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0, 20.0, 20.0)
"""Effort limits of the URDF: N m for the arm's joints, N for the fingers."""

_PALETTE_CELL_PX = 8


@dataclass(frozen=True)
class ArmModel:
    """Two URDFs of the same kinematics: one to draw (few faces, no contacts), one to touch (hulls, nothing drawn).

    Attributes:
        visual: URDF for a renderer.
        physics: URDF for a simulator.
        boxes: link index -> (8, 3) corners of the visual mesh's bounding box in the link's frame, metres.
    """

    visual: Path
    physics: Path
    boxes: dict[int, np.ndarray]


def arm_model() -> ArmModel:
    """The arm made from the `franka_panda` model in `pybullet_data`, cached."""
    source = Path(load_pybullet_data()) / "franka_panda"
    sources = sorted(path for path in source.rglob("*") if path.suffix in {".urdf", ".obj", ".mtl", ".png"})
    recipe: dict[str, object] = {
        "faces": FACE_SHARE,
        "sources": {str(path.relative_to(source)): file_hash(path) for path in sources},
    }
    folder = made_once("panda", recipe, lambda target: _make(source, target))
    boxes = np.load(folder / "boxes.npz")
    return ArmModel(folder / "visual.urdf", folder / "physics.urdf", {int(link): boxes[link] for link in boxes.files})


def _make(source: Path, target: Path) -> None:
    tree = ElementTree.parse(source / "panda.urdf")
    links = [link.get("name") for link in tree.getroot().findall("link")]
    child_of = [joint.find("child").get("link") for joint in tree.getroot().findall("joint")]  # type: ignore[union-attr]
    _check_order(links, child_of)
    boxes: dict[str, np.ndarray] = {}
    for element in tree.getroot().iter("mesh"):
        element.set("filename", element.get("filename", "").removeprefix("package://"))
    for link in tree.getroot().findall("link"):
        drawn = link.find("visual")
        if drawn is None:
            continue
        mesh = drawn.find("geometry/mesh")
        assert mesh is not None
        name = f"{link.get('name')}"
        corners = _redraw(source / mesh.get("filename", ""), target / f"{name}.obj")
        if drawn.find("origin") is not None and link.get("name") == "panda_rightfinger":
            corners = corners * [-1, -1, 1]
        boxes[str(child_of.index(name) if name in child_of else -1)] = corners
        mesh.set("filename", f"{name}.obj")
    _write_without(tree, "collision", target / "visual.urdf")
    tree = ElementTree.parse(source / "panda.urdf")
    for link in tree.getroot().findall("link"):
        touched = link.find("collision/geometry/mesh")
        if touched is None:
            continue
        path = source / touched.get("filename", "").removeprefix("package://")
        points = np.asarray(trimesh.load(path, force="mesh").vertices)
        name = f"{link.get('name')}_hull.obj"
        meshes.write_hulls(target / name, [meshes.hull_vertices(points, 100)])
        touched.set("filename", name)
    _write_without(tree, "visual", target / "physics.urdf")
    np.savez(target / "boxes.npz", **boxes)  # type: ignore[arg-type]


def _check_order(links: list[str | None], child_of: list[str | None]) -> None:
    """PyBullet numbers links in the order of its own depth-first walk; here that is the file's order of joints."""
    assert len(links) == len(child_of) + 1


def _write_without(tree: ElementTree.ElementTree, kind: str, path: Path) -> None:
    for link in tree.getroot().findall("link"):  # type: ignore[union-attr]
        for part in link.findall(kind):
            link.remove(part)
    tree.write(path)


def _redraw(source: Path, target: Path) -> np.ndarray:
    """Write a copy with few faces and one flat colour per face; returns its bounding box's corners."""
    points, triangles, colours = _coloured_faces(source)
    mesh = trimesh.Trimesh(points, triangles, process=False)
    count = len(triangles) if len(triangles) < 1000 else max(120, int(FACE_SHARE * len(triangles)))
    vertices, faces = meshes.decimate(mesh, count)
    tree = cKDTree(points[triangles].mean(axis=1))
    nearest = tree.query(vertices[faces].mean(axis=1))[1]
    palette, index = np.unique(colours[nearest], axis=0, return_inverse=True)
    picture = np.repeat(palette[None].astype(np.uint8), _PALETTE_CELL_PX, axis=0)
    picture = np.repeat(picture, _PALETTE_CELL_PX, axis=1)
    Image.fromarray(picture).save(target.with_suffix(".png"))
    uv = np.empty((len(faces), 3, 2))
    uv[..., 0] = ((index.ravel() + 0.5) / len(palette))[:, None]
    uv[..., 1] = 0.5
    meshes.write_obj(target, vertices, faces, meshes.corner_normals(vertices, faces), uv, f"{target.stem}.png")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def _coloured_faces(source: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3), triangles (F, 3) and an RGB colour per triangle (F, 3), coarse enough to share a palette."""
    loaded = trimesh.load(source)
    parts = list(loaded.geometry.values()) if isinstance(loaded, trimesh.Scene) else [loaded]
    points, triangles, colours, first = [], [], [], 0
    for part in parts:
        points.append(np.asarray(part.vertices))
        triangles.append(np.asarray(part.faces) + first)
        colours.append(_face_colours(part))
        first += len(part.vertices)
    return np.concatenate(points), np.concatenate(triangles), np.concatenate(colours)


def _face_colours(part: trimesh.Trimesh) -> np.ndarray:
    material = getattr(part.visual, "material", None)
    if material is None:
        return np.full((len(part.faces), 3), 255)
    image = getattr(material, "image", None)
    if image is None or part.visual.uv is None:
        colour = np.asarray(material.main_color)[:3]
        return np.tile(colour, (len(part.faces), 1))
    picture = np.asarray(image.convert("RGB"))
    centre = part.visual.uv[part.faces].mean(axis=1) % 1.0
    rows = ((1 - centre[:, 1]) * (picture.shape[0] - 1)).astype(int)
    columns = (centre[:, 0] * (picture.shape[1] - 1)).astype(int)
    return picture[rows, columns] // 24 * 24


def joint_path(bullet: Any, arm: int, points: np.ndarray, yaw_rad: float) -> tuple[np.ndarray, float]:
    """Joint angles (N, 7) that bring the point between the fingertips to each of `points` (N, 3), gripper down.

    The arm is left in the first configuration.

    Returns:
        The angles, and the largest distance in metres between a point and where the arm really gets.
    """
    down = bullet.call("getQuaternionFromEuler", (np.pi, 0.0, yaw_rad))
    reset(bullet, arm, np.array(REST_RAD))
    angles, error = [], 0.0
    spans = np.subtract(UPPER_RAD, LOWER_RAD).tolist()
    for number, point in enumerate(points):
        for _ in range(20 if number == 0 else 3):
            solution = bullet.call(
                "calculateInverseKinematics",
                arm,
                GRASP_LINK,
                point.tolist(),
                down,
                lowerLimits=list(LOWER_RAD),
                upperLimits=list(UPPER_RAD),
                jointRanges=spans,
                restPoses=list(REST_RAD),
                maxNumIterations=40,
                residualThreshold=1e-6,
            )
            reset(bullet, arm, np.array(solution[:7]))
        reached = bullet.call("getLinkState", arm, GRASP_LINK, computeForwardKinematics=True)[4]
        error = max(error, float(np.linalg.norm(np.subtract(reached, point))))
        angles.append(solution[:7])
    reset(bullet, arm, np.array(angles[0]))
    return np.array(angles), error


def reset(bullet: Any, arm: int, angles: np.ndarray) -> None:
    """Put the arm at rest in joint angles (7,), fingers closed."""
    for joint, angle in zip(JOINTS, [*angles.tolist(), 0.0, 0.0], strict=True):
        bullet.call("resetJointState", arm, joint, angle, 0.0)
