"""The RGB-D camera of the task."""

from __future__ import annotations

import os
from functools import lru_cache

import numpy as np

from sims.arrangement.cell import OPEN_M, RETRACTED
from sims.arrangement.sensor import stereo
from sims.arrangement.settings import Settings
from sims.arrangement.types import Truth, View
from sims.assets import object_models
from sims.render import Renderer


class Studio:
    """Takes images of objects on the table. One per process and settings: `studio`."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._renderer = Renderer(settings.camera, settings.image_size, settings.renderer)
        self._names: tuple[str, ...] | None = None

    def view(self, names: tuple[str, ...], poses: np.ndarray, joints: np.ndarray | None = None) -> View:
        """One image.

        Args:
            names: classes of the objects.
            poses: (O, 7) their frames: x, y, z in metres, quaternion x, y, z, w.
            joints: (9,) angles (rad) and finger positions (m) of the arm; None: retracted, outside the image.
        """
        if names != self._names:
            self._renderer.show(object_models(names, None, self.settings.image_size))
            self._names = names
        if joints is None:
            joints = np.array([*RETRACTED, OPEN_M, OPEN_M])
        picture = self._renderer.picture(joints, np.asarray(poses, dtype=np.float64).reshape(-1, 7))
        depth = stereo(picture.depth) if self.settings.depth == "stereo" else picture.depth
        return View(picture.rgb, depth, self.settings.camera, Truth(picture.segmentation, names))


def studio(settings: Settings) -> Studio:
    """The process's studio for these settings."""
    return _studio(os.getpid(), settings)


@lru_cache(maxsize=1)
def _studio(process: int, settings: Settings) -> Studio:
    return Studio(settings)
