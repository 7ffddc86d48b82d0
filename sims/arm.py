"""The Panda arm: PyBullet's own model, redrawn with few faces, and the way it follows a straight line."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from sims import meshes, surfaces
from sims.cache import file_hash, made_once
from sims.bullet import load_pybullet_data

FACES = {
    "panda_link0": 200,
    "panda_link1": 200,
    "panda_link2": 200,
    "panda_link3": 250,
    "panda_link4": 250,
    "panda_link5": 350,
    "panda_link6": 450,
    "panda_link7": 200,
    "panda_hand": 450,
    "panda_leftfinger": 120,
    "panda_rightfinger": 120,
}
"""Triangles kept of each drawn link, of 101,735 in all."""
CELL_PX = 10
POINTS_PER_M2 = 400_000

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
        "faces": FACES,
        "cell_px": CELL_PX,
        "points_per_m2": POINTS_PER_M2,
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
    """Write a copy with few faces, its colours baked into a picture; returns its bounding box's corners (8, 3)."""
    original = trimesh.load(source)
    parts = list(original.geometry.values()) if isinstance(original, trimesh.Scene) else [original]
    merged = trimesh.util.concatenate([trimesh.Trimesh(part.vertices, part.faces, process=False) for part in parts])
    if len(merged.faces) <= FACES[target.stem]:
        vertices, triangles = meshes.decimate(merged, len(merged.faces))
        normals = meshes.corner_normals(vertices, triangles)
    else:
        smooth = surfaces.outer_surface(merged)
        vertices, triangles = meshes.decimate(smooth, FACES[target.stem])
        normals = surfaces.transferred_normals(vertices, triangles, smooth)
    points, colours = _coloured_points(parts)
    picture, uv = surfaces.bake(vertices, triangles, points, colours, CELL_PX)
    Image.fromarray(picture).save(target.with_suffix(".png"))
    meshes.write_obj(target, vertices, triangles, normals, uv, f"{target.stem}.png")
    return meshes.box_corners(vertices)


def _coloured_points(parts: list[trimesh.Trimesh]) -> tuple[np.ndarray, np.ndarray]:
    """Points spread over all parts (N, 3) and their colours (N, 3) uint8."""
    points, colours = [], []
    for part in parts:
        count = max(50, int(part.area * POINTS_PER_M2))
        where, face = trimesh.sample.sample_surface(part, count, seed=0)
        points.append(where)
        colours.append(_face_colours(part)[face])
    return np.concatenate(points), np.concatenate(colours).astype(np.uint8)


def _face_colours(part: trimesh.Trimesh) -> np.ndarray:
    """(F, 3) a colour per triangle: of its texture's middle, or else of its material."""
    material = getattr(part.visual, "material", None)
    if material is None:
        return np.full((len(part.faces), 3), 255)
    image = getattr(material, "image", None)
    if image is None or part.visual.uv is None:
        return np.tile(np.asarray(material.main_color)[:3], (len(part.faces), 1))
    picture = np.asarray(image.convert("RGB"))
    centre = part.visual.uv[part.faces].mean(axis=1) % 1.0
    rows = ((1 - centre[:, 1]) * (picture.shape[0] - 1)).astype(int)
    columns = (centre[:, 0] * (picture.shape[1] - 1)).astype(int)
    return picture[rows, columns]


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
