"""The natural order of names that hold numbers: frame 2 before frame 10."""

from __future__ import annotations

import re
from pathlib import Path

_NUMBER = re.compile(r"(\d+)", re.ASCII)


def natural_key(name: str) -> tuple[tuple[str | int, ...], str]:
    """Sorts names by their text and the values of their numbers; equal ones (`1`, `01`) by the text alone.

    Example:
        >>> sorted(["v10", "v2", "v1"], key=natural_key)
        ['v1', 'v2', 'v10']
    """
    parts = _NUMBER.split(name)
    # Text and numbers stand at even and odd places, so equal places hold values of one type.
    return tuple(int(part) if place % 2 else part for place, part in enumerate(parts)), name


def natural_path_key(path: Path) -> list[tuple[tuple[str | int, ...], str]]:
    """Sorts paths folder by folder, each name in natural order."""
    return [natural_key(part) for part in path.parts]
