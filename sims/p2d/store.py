"""The P2D folder as a recording: its arrays, its settings, its place in a manifest.

```
<root>/manifest.json        written last, atomically: a folder without it is unfinished
<root>/trajectories.jsonl   first line: settings and facts; then one line with a checksum per finished trajectory
<root>/<split>/<field>.npy  one array per field of `Trajectory`, first axis the trajectory
```

Bytes, manifests and fingerprints are older than `recordings/`, which reads and writes them as they were.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

import recordings
from recordings import Field, Layout, Plan
from sims.p2d.readme import readme
from sims.p2d.settings import CROWDED, Settings

SPLITS = ("train", "val", "test")

SIMULATION_VERSION = 1
"""Raise whenever the simulation gives other bytes for the same settings, so that old and new data are not mixed."""
CROWDED_VERSION = 3
"""Instead of it for settings with `CROWDED` objects or more: 2 since their places are drawn many at once, 3 since fewer
tries are made with the same classes."""

FIELDS: dict[str, Field] = {
    "rgb": Field("|u1", ("T", "S", "S", 3)),
    "segmentation": Field("|u1", ("T", "S", "S")),
    "depth": Field("<f2", ("T", "S", "S")),
    "classes": Field("<i2", ("O",)),
    "poses": Field("<f4", ("T", "O", 7)),
    "joints": Field("<f4", ("T", 9)),
    "gripper": Field("<f4", ("T", 7)),
    "visible_px": Field("<i4", ("T", "O+1")),
    "amodal_px": Field("<i4", ("T", "O+1")),
    "arm_contact": Field("|b1", ("T", "O")),
    "object_contact": Field("|b1", ("T", "O", "O")),
    "aimed": Field("|b1", ()),
    "redraws": Field("<i4", ()),
}
"""T frames, S image size, O object slots."""

Manifest = recordings.Manifest[Settings]
"""Its facts are `versions`, `camera` and `classes`, the class names by the values of array `classes`."""


@dataclass(frozen=True)
class P2DKind(recordings.Kind[Settings]):
    """The kind of all P2D folders: the settings determine the layout."""

    name: str = "P2D"
    make_command: str = "python -m sims.p2d --out {root}"
    repair_command: str = "python -m sims.p2d verify {root} --repair"
    item: str = "trajectory"
    items: str = "trajectories"
    notes: tuple[str, ...] = ("redraws",)
    totals: tuple[str, ...] = ("redraws",)
    describes_itself: bool = False

    def parse(self, data: dict[str, Any]) -> Settings:
        """Settings from JSON data."""
        try:
            return Settings.model_validate_json(json.dumps(data))
        except ValidationError as error:
            raise ValueError(str(error)) from None

    def dump(self, settings: Settings) -> dict[str, Any]:
        """Settings as JSON data."""
        return settings.model_dump(mode="json")

    def identity(self, settings: Settings) -> dict[str, Any]:
        """What else the fingerprint covers."""
        return {"simulation": simulation_version(settings)}

    def layout(self, settings: Settings, stored: Mapping[str, Any]) -> Layout:
        """The arrays of a folder with these settings."""
        return layout(settings)

    def readme(self, manifest: Manifest) -> str:
        """The README.md of a finished folder."""
        return readme(manifest)


KIND = P2DKind()


def simulation_version(settings: Settings) -> int:
    """The version of the simulation for these settings."""
    return CROWDED_VERSION if settings.max_objects >= CROWDED else SIMULATION_VERSION


def layout(settings: Settings) -> Layout:
    """The arrays of a data set with these settings."""
    sizes = {
        "T": settings.frames,
        "S": settings.image_size,
        "O": settings.max_objects,
        "O+1": settings.max_objects + 1,
    }
    return Layout(FIELDS, {split: getattr(settings, split) for split in SPLITS}, sizes)


def plan(settings: Settings) -> Plan[Settings]:
    """What a folder with these settings holds."""
    return Plan(KIND, settings, layout(settings))


def fingerprint(settings: Settings) -> str:
    """16 hex digits over the settings and the versions of simulation and format."""
    return plan(settings).fingerprint


def read_manifest(root: Path) -> Manifest:
    """Reads the manifest of a finished folder.

    Raises:
        SimError: no folder, not finished, damaged, or written by another version; each with the command that helps.
    """
    return recordings.read_manifest(root, KIND)


def check(root: Path, settings: Settings | None = None, splits: Iterable[str] = SPLITS) -> Manifest:
    """The cheap check: manifest, format, files' presence, sizes and headers. Reads no data.

    Args:
        root: the folder.
        settings: the settings that the data must have; None: any.
        splits: the splits whose files are checked.

    Raises:
        SimError: with the first problem and the command that fixes it.
    """
    return recordings.check(root, KIND, plan(settings) if settings is not None else None, splits)
