"""Textured models from a user's folder: one sub-folder per object, with an OBJ and its texture image."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from sims.errors import SimError

PICTURE_PX = 1024
"""Larger textures are downsampled to this side first."""


@dataclass(frozen=True)
class TexturedModel:
    """Files of one textured object."""

    mesh: Path
    picture: Path


def plain_name(name: str) -> str:
    """A name without the set's prefixes: '011_banana', 'YcbBanana' and 'banana' are all 'banana'."""
    bare = re.sub(r"[^a-z0-9]", "", name.lower())
    return re.sub(r"^(ycb|\d{3})+", "", bare)


def find(root: str, name: str) -> TexturedModel:
    """The textured model of a class in the folder `root`.

    Raises:
        SimError: the folder, the object's sub-folder, its OBJ with texture coordinates or its texture is missing.
    """
    folder = Path(root).expanduser()
    if not folder.is_dir():
        raise SimError(f"objects_root {root!r} is not a folder: name the folder that has one sub-folder per object.")
    there = {plain_name(path.name): path for path in sorted(folder.iterdir()) if path.is_dir()}
    place = there.get(plain_name(name))
    if place is None:
        found = ", ".join(path.name for path in there.values()) or "nothing"
        raise SimError(
            f"objects_root {root!r} has no sub-folder for object {name!r} (it has {found}): add it, or leave it "
            "out of objects."
        )
    meshes = [path for path in sorted(place.rglob("*.obj")) if _has_texture_coordinates(path)]
    if not meshes:
        raise SimError(f"{place} has no OBJ file with texture coordinates: put the object's textured OBJ there.")
    mesh = next((path for path in meshes if "textured" in path.name), meshes[0])
    return TexturedModel(mesh, _picture(mesh))


def _has_texture_coordinates(path: Path) -> bool:
    with path.open() as lines:
        return any(line.startswith("vt ") for line in lines)


def _picture(mesh: Path) -> Path:
    """The texture that the OBJ's material names, else the only PNG beside it."""
    for material in mesh.parent.glob("*.mtl"):
        for line in material.read_text().splitlines():
            words = line.split(maxsplit=1)
            if len(words) == 2 and words[0] == "map_Kd" and f"mtllib {material.name}" in _head(mesh):
                named = mesh.parent / Path(words[1].strip()).name
                if named.is_file():
                    return named
                raise SimError(
                    f"{material} names the texture {words[1].strip()!r}, which is missing: put it beside that file."
                )
    pictures = sorted(mesh.parent.glob("*.png"))
    if len(pictures) != 1:
        raise SimError(
            f"{mesh.parent} has {len(pictures)} PNG files and no material names the texture of {mesh.name}: "
            "add an MTL file."
        )
    return pictures[0]


def _head(path: Path, characters: int = 2000) -> str:
    with path.open() as text:
        return text.read(characters)


def load(model: TexturedModel) -> trimesh.Trimesh:
    """The mesh with its texture coordinates.

    Raises:
        SimError: the file's texture coordinates do not match its faces.
    """
    mesh = trimesh.load_mesh(model.mesh, process=False)
    if isinstance(mesh, trimesh.Scene):
        mesh = mesh.to_mesh()
    if not isinstance(mesh, trimesh.Trimesh) or getattr(mesh.visual, "uv", None) is None:
        raise SimError(f"{model.mesh} has texture coordinates that do not match its faces: export it again.")
    return mesh


def texture_coordinates(mesh: trimesh.Trimesh) -> np.ndarray:
    """(V, 2) of a mesh from `load`, v upwards."""
    return np.asarray(getattr(mesh.visual, "uv"))  # noqa: B009 - only some kinds of visual have it


def picture_of(model: TexturedModel) -> Image.Image:
    """The texture, at most `PICTURE_PX` wide and high."""
    image = Image.open(model.picture).convert("RGB")
    if max(image.size) > PICTURE_PX:
        image = image.resize((PICTURE_PX, PICTURE_PX), Image.Resampling.BOX)
    return image


def coloured_points(mesh: trimesh.Trimesh, model: TexturedModel, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly over a textured mesh (N, 3) and their colours (N, 3) uint8."""
    pixels = np.asarray(picture_of(model))
    points, face = trimesh.sample.sample_surface(mesh, count, seed=0)
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[face], points)
    uv = (texture_coordinates(mesh)[mesh.faces[face]] * weights[..., None]).sum(axis=1) % 1.0
    row = np.clip(((1 - uv[:, 1]) * pixels.shape[0]).astype(int), 0, pixels.shape[0] - 1)
    column = np.clip((uv[:, 0] * pixels.shape[1]).astype(int), 0, pixels.shape[1] - 1)
    return np.asarray(points), pixels[row, column]
