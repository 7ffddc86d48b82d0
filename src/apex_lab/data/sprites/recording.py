"""Sprites as a recording: drawn once, then read. Imports no PyTorch, since worker processes import it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from apex_lab.data.sprites.drawing import SPLITS, VERSION, draw_sprites, drawn
from recordings import Facts, Field, Item, Kind, Layout, Maker, Plan

KIND: Kind[dict[str, Any]] = Kind(
    "sprites",
    make_command="python -m apex_lab.train data=sprites data.stored=true",
    repair_command="python -m apex_lab.data.sprites verify {root} --repair",
    version=VERSION,
    item="video",
    items="videos",
    about="Coloured shapes that move over a plain ground. The settings determine every pixel.",
)

FIELDS = {
    "rgb": Field("|u1", ("T", "S", "S", 3), "colour"),
    "segmentation": Field("|u1", ("T", "S", "S"), "0 the ground, 1 and up the sprites; the same number all through"),
}


def plan(settings: Mapping[str, Any]) -> Plan[dict[str, Any]]:
    """What a folder with these settings (those of `SpritesSource`) holds."""
    sizes = {"T": settings["frames"], "S": settings["image_size"]}
    return Plan(KIND, dict(settings), Layout(FIELDS, {split: settings[split] for split in SPLITS}, sizes))


@dataclass(frozen=True)
class Drawer(Maker):
    """Draws videos."""

    settings: Mapping[str, Any]

    def facts(self) -> Facts:
        """The version of what draws."""
        return {"versions": {"opencv": cv2.__version__}}

    def make(self, split: str, index: int) -> Item:
        """Draws one video."""
        settings = self.settings
        sprites = draw_sprites(settings["data_seed"], split, index, (settings["min_objects"], settings["max_objects"]))
        frames = [drawn(sprites, frame, settings["image_size"]) for frame in range(settings["frames"])]
        images, labels = zip(*frames, strict=True)
        return Item({"rgb": np.stack(images), "segmentation": np.stack(labels)})
