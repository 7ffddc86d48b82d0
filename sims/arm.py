"""The Panda arm: PyBullet's model with decimated meshes, and inverse kinematics along a straight line."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from sims import meshes, surfaces
from sims.bullet import Client, load_pybullet_data
from sims.cache import file_hash, made_once
from sims.poses import rotation

FACES = {
    "panda_link0": 120,
    "panda_link1": 120,
    "panda_link2": 120,
    "panda_link3": 160,
    "panda_link4": 160,
    "panda_link5": 300,
    "panda_link6": 420,
    "panda_link7": 200,
    "panda_hand": 400,
    "panda_leftfinger": 100,
    "panda_rightfinger": 100,
}
"""Triangles of each decimated link; the original links have 101,735 in all."""
CELL_PX = 10
IK_CALLS, IK_ERROR_M = 30, 2e-4
"""PyBullet's solver converges slowly: it is called repeatedly from its last solution until within tolerance."""
POINTS_PER_M2 = 400_000

JOINTS = (0, 1, 2, 3, 4, 5, 6, 9, 10)
"""PyBullet's indices of the seven arm joints and the two fingers."""
BASE_LINK = "panda_link0"
GRASP_LINK = 11
"""The point between the fingertips, 0.105 m from the hand's flange."""
REST_RAD = (0.0, 0.3, 0.0, -2.2, 0.0, 2.5, 0.785)
LOWER_RAD = (-2.9671, -1.8326, -2.9671, -3.1416, -2.9671, -0.0873, -2.9671)
UPPER_RAD = (2.9671, 1.8326, 2.9671, 0.0, 2.9671, 3.8223, 2.9671)
FORCE_N = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0, 20.0, 20.0)
"""Effort limits of the URDF: N m for the arm's joints, N for the fingers."""


@dataclass(frozen=True)
class ArmModel:
    """Three URDFs of the same kinematics: original, visual (decimated, no collisions), physics (hulls, no visuals).

    Attributes:
        original: PyBullet's own URDF.
        visual: URDF for a stage.
        physics: URDF for a world.
        hulls: link name -> (N, 3) metres, vertices of the visual link's convex hull in the link's frame.
    """

    original: Path
    visual: Path
    physics: Path
    hulls: dict[str, np.ndarray]


class Links:
    """World positions of the visual links."""

    def __init__(self, model: ArmModel) -> None:
        self._hulls = model.hulls
        self._order: list[tuple[int, np.ndarray]] = []

    def points(self, bullet: Client, arm: int) -> list[np.ndarray]:
        """World vertices (N, 3) of each link's hull, in metres, base first."""
        if not self._order:
            count = bullet.call("getNumJoints", arm)
            names = [bullet.call("getJointInfo", arm, joint)[12].decode() for joint in range(count)]
            self._order = [(i, self._hulls[name]) for i, name in enumerate(names) if name in self._hulls]
        states = bullet.call("getLinkStates", arm, [i for i, _ in self._order], computeForwardKinematics=True)
        points = [self._hulls[BASE_LINK]]
        for (_, hull), state in zip(self._order, states, strict=True):
            points.append(hull @ rotation(state[5]).T + state[4])
        return points


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
    hulls = np.load(folder / "hulls.npz", allow_pickle=False)
    files = source / "panda.urdf", folder / "visual.urdf", folder / "physics.urdf"
    return ArmModel(*files, {name: hulls[name] for name in hulls.files})


def _make(source: Path, target: Path) -> None:
    """Write both URDFs with their meshes, and the visual links' hulls."""
    hulls: dict[str, np.ndarray] = {}
    for kind, other in (("visual", "collision"), ("collision", "visual")):
        tree = ElementTree.parse(source / "panda.urdf")
        for link in tree.findall("link"):
            for unwanted in link.findall(other):
                link.remove(unwanted)
            part = link.find(kind)
            mesh = None if part is None else part.find("geometry/mesh")
            if part is None or mesh is None:
                continue
            name = str(link.get("name"))
            original = source / str(mesh.get("filename")).removeprefix("package://")
            mesh.set("filename", f"{name}_{kind}.obj")
            if kind == "visual":
                points = _redraw(original, target / f"{name}_visual.obj", FACES[name])
                hulls[name] = _moved(points[ConvexHull(points).vertices], part.find("origin"))
            else:
                points = np.asarray(trimesh.load_mesh(original).vertices)
                meshes.write_hulls(target / f"{name}_collision.obj", [meshes.hull_vertices(points, 100)])
        tree.write(target / {"visual": "visual.urdf", "collision": "physics.urdf"}[kind])
    np.savez(target / "hulls.npz", **hulls)  # type: ignore[arg-type]


def _moved(points: np.ndarray, origin: ElementTree.Element | None) -> np.ndarray:
    """Points of a mesh in its link's frame, by the URDF's origin element."""
    if origin is None:
        return points
    shift, turn = ([float(word) for word in origin.get(key, "0 0 0").split()] for key in ("xyz", "rpy"))
    return Rotation.from_euler("xyz", turn).apply(points) + shift


def _redraw(source: Path, target: Path, faces: int) -> np.ndarray:
    """Write a decimated copy with its colours baked into a texture; returns its vertices (N, 3)."""
    scene = trimesh.load_scene(source)
    parts = [part for part in scene.geometry.values() if isinstance(part, trimesh.Trimesh)]
    ends = np.cumsum([0, *(len(part.vertices) for part in parts)])
    merged = trimesh.Trimesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + first for part, first in zip(parts, ends, strict=False)]),
        process=False,
    )
    if len(merged.faces) <= faces:
        vertices, triangles = meshes.decimate(merged, faces)
        normals = meshes.corner_normals(vertices, triangles)
    else:
        smooth = surfaces.outer_surface(merged)
        vertices, triangles = meshes.decimate(smooth, faces)
        normals = surfaces.transferred_normals(vertices, triangles, smooth)
    points, colours = _coloured_points(parts)
    picture, uv = surfaces.bake(vertices, triangles, points, colours, CELL_PX)
    Image.fromarray(picture).save(target.with_suffix(".png"))
    meshes.write_obj(target, vertices, triangles, normals, uv, f"{target.stem}.png")
    return vertices


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
    """(F, 3) a colour per triangle: the texture at its centroid, else its material."""
    material, uv = getattr(part.visual, "material", None), getattr(part.visual, "uv", None)
    if material is None:
        return np.full((len(part.faces), 3), 255)
    image = getattr(material, "image", None)
    if image is None or uv is None:
        return np.tile(np.asarray(material.main_color)[:3], (len(part.faces), 1))
    picture = np.asarray(image.convert("RGB"))
    centre = uv[part.faces].mean(axis=1) % 1.0
    rows = ((1 - centre[:, 1]) * (picture.shape[0] - 1)).astype(int)
    columns = (centre[:, 0] * (picture.shape[1] - 1)).astype(int)
    return picture[rows, columns]


def joint_path(bullet: Client, arm: int, points: np.ndarray, yaw_rad: float) -> tuple[np.ndarray, float]:
    """Joint angles (N, 7) that put the point between the fingertips at each of `points` (N, 3), gripper down.

    By inverse kinematics; leaves the arm in the first configuration.

    Returns:
        The angles, and the largest distance in metres between a point and the position reached.
    """
    down = bullet.call("getQuaternionFromEuler", (np.pi, 0.0, yaw_rad))
    bounds = {
        "lowerLimits": LOWER_RAD,
        "upperLimits": UPPER_RAD,
        "jointRanges": np.subtract(UPPER_RAD, LOWER_RAD).tolist(),
        "restPoses": REST_RAD,
        "maxNumIterations": 40,
        "residualThreshold": 1e-6,
    }
    reset(bullet, arm, np.array(REST_RAD))
    angles, worst = [], 0.0
    for point in points.tolist():
        for _ in range(IK_CALLS):
            solution = bullet.call("calculateInverseKinematics", arm, GRASP_LINK, point, down, **bounds)[:7]
            reset(bullet, arm, np.array(solution))
            reached = bullet.call("getLinkState", arm, GRASP_LINK, computeForwardKinematics=True)[4]
            error = float(np.linalg.norm(np.subtract(reached, point)))
            if error < IK_ERROR_M:
                break
        worst = max(worst, error)
        angles.append(solution)
    reset(bullet, arm, np.array(angles[0]))
    return np.array(angles), worst


def reset(bullet: Client, arm: int, angles: np.ndarray) -> None:
    """Put the arm at rest in joint angles (7,), fingers closed."""
    for joint, angle in zip(JOINTS, [*angles.tolist(), 0.0, 0.0], strict=True):
        bullet.call("resetJointState", arm, joint, angle, 0.0)
