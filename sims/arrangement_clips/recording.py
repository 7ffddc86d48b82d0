"""The clips as a recording: arrays, settings, and what makes them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

import recordings
from recordings import Damage, Facts, Field, Item, Kind, Layout, Maker, Plan
from sims import assets
from sims.arrangement_clips.clip import SPLITS, drawn, sample
from sims.arrangement_clips.settings import Settings
from sims.errors import wrong_setting

VERSION = 1
"""Raised whenever the same settings give other bytes."""

RECYCLE = 400
"""Clips after which a worker is replaced: the renderer's memory grows."""

FIELDS = {
    "rgb": Field("|u1", ("T", "S", "S", 3), "colour"),
    "segmentation": Field("|u1", ("T", "S", "S"), "0 background, 2 + i object i; the same number through the clip"),
    "classes": Field("<i2", ("O",), "index into facts.classes of each object; -1: there is none"),
    "poses": Field(
        "<f4", ("T", "O", 7), "x, y, z in metres and quaternion x, y, z, w of each object; 0: there is none"
    ),
}


@dataclass(frozen=True)
class ClipsKind(Kind[Settings]):
    """The kind of all these folders: the settings determine the layout."""

    name: str = "arrangement"
    make_command: str = "python -m sims.arrangement_clips make {root}"
    repair_command: str = "python -m sims.arrangement_clips verify {root} --repair"
    version: int = VERSION
    item: str = "clip"
    items: str = "clips"

    def parse(self, data: dict[str, Any]) -> Settings:
        """Settings from JSON data."""
        try:
            return Settings.model_validate_json(json.dumps(data))
        except ValidationError as error:
            raise ValueError(wrong_setting(error, Settings)) from None

    def dump(self, settings: Settings) -> dict[str, Any]:
        """Settings as JSON data."""
        return settings.model_dump(mode="json")

    def layout(self, settings: Settings, stored: Mapping[str, Any]) -> Layout:
        """The arrays of a folder with these settings."""
        return layout(settings)


KIND = ClipsKind()


def layout(settings: Settings) -> Layout:
    """The arrays of a data set with these settings."""
    sizes = {"T": settings.frames, "S": settings.image_size, "O": settings.max_objects}
    return Layout(FIELDS, {split: getattr(settings, split) for split in SPLITS}, sizes)


def plan(settings: Settings) -> Plan[Settings]:
    """What a folder with these settings holds."""
    return Plan(KIND, settings, layout(settings))


@dataclass(frozen=True)
class Clips(Maker):
    """Draws clips."""

    settings: Settings

    def facts(self) -> Facts:
        """Versions of everything besides the settings that determines the bytes, and the class names."""
        return {
            "versions": {"clips": str(VERSION), "models": str(assets.FORMAT), **assets.versions()},
            "classes": list(self.settings.objects),
        }

    def make(self, split: str, index: int) -> Item:
        """Draws one clip."""
        settings = self.settings
        clip = sample(settings, split, index)
        frames = drawn(settings, clip)
        classes = np.full(settings.max_objects, -1, dtype=np.int16)
        classes[: len(clip.names)] = [settings.objects.index(name) for name in clip.names]
        poses = np.zeros((settings.frames, settings.max_objects, 7), dtype=np.float32)
        poses[:, : len(clip.names)] = clip.poses
        arrays = {"rgb": frames.rgb, "segmentation": frames.segmentation, "classes": classes, "poses": poses}
        return Item(arrays)


def make(root: Path, settings: Settings, workers: int | None = None) -> recordings.Manifest[Settings]:
    """Makes the data set in a folder; finished clips are kept.

    Raises:
        SimError: the folder has other content, the disk is full, or the simulator is missing.
    """
    return recordings.record(root, plan(settings), Clips(settings), workers=workers, recycle=RECYCLE)


def repair(root: Path, workers: int | None = None) -> Damage:
    """Makes damaged clips again; the damage that was found.

    Raises:
        SimError: as `make`.
    """
    return recordings.repair(root, KIND, lambda there, facts: Clips(there.settings), workers=workers)
