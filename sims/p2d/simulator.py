"""The PyBullet simulator, with the interface that `generate` expects."""

from __future__ import annotations

import hashlib
import platform
from pathlib import Path

from recordings import Facts
from sims import assets
from sims.p2d.settings import Settings
from sims.p2d.simulate import camera, simulate
from sims.p2d.store import simulation_version

__all__ = ["facts", "simulate"]


def facts(settings: Settings) -> Facts:
    """Versions of everything besides the settings that determines the bytes, the camera, the class names."""
    versions = {
        "simulation": str(simulation_version(settings)),
        "models": str(assets.FORMAT),
        **assets.versions(),
        "machine": platform.machine(),
    }
    if settings.objects_root is not None:
        versions["objects_root"] = _digest(Path(settings.objects_root))
    return {"versions": versions, "camera": camera(settings), "classes": list(settings.objects)}


def _digest(folder: Path) -> str:
    """Digest of the names and bytes of all files in a folder of models."""
    digest = hashlib.blake2b(digest_size=8)
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            digest.update(f"{path.relative_to(folder).as_posix()}\0{path.stat().st_size}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()
