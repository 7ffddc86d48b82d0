"""What the controller knows of an image: a body per detection, and bodies that no detection covers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sims.arrangement import cloud
from sims.arrangement.cloud import Body
from sims.arrangement.settings import Settings
from sims.arrangement.types import Detection, View

BEYOND_M = 0.08
"""Bodies up to this far outside the edge around the workspace count."""


@dataclass(frozen=True, eq=False)
class Item:
    """A detection with a body on the table.

    Attributes:
        number: index of the detection.
    """

    number: int
    appearance: np.ndarray
    body: Body


@dataclass(frozen=True, eq=False)
class Scene:
    """One image understood.

    Attributes:
        detections: as perceived.
        items: those with a body.
        strangers: bodies under no mask: obstacles that cannot be named.
    """

    view: View
    detections: tuple[Detection, ...]
    items: tuple[Item, ...]
    strangers: tuple[Body, ...]

    def others(self, body: Body) -> list[Body]:
        """All bodies but this one and those that are parts or doubles of it."""
        every = [item.body for item in self.items] + list(self.strangers)
        return [other for other in every if other is not body and not same(other, body)]


def see(view: View, detections: list[Detection], settings: Settings) -> Scene:
    """Bodies from masks and depth.

    Raises:
        ValueError: a mask has another shape than the image: a fault of the perception, not of the scene.
    """
    points = cloud.points_of(view)
    items = []
    for number, detection in enumerate(detections):
        mask = np.asarray(detection.mask, dtype=bool)
        if mask.shape != view.depth.shape:
            raise ValueError(f"detection {number} has a mask of shape {mask.shape}, its image {view.depth.shape}")
        body = cloud.body_of(view, points, mask)
        if body is not None:
            items.append(Item(number, np.atleast_1d(detection.appearance), body))
    low, high = bounds(settings)
    masks = [np.asarray(detection.mask, dtype=bool) for detection in detections]
    found = cloud.strangers(view, points, masks, low - BEYOND_M, high + BEYOND_M)
    return Scene(view, tuple(detections), tuple(items), tuple(found))


def bounds(settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """Corners (2,) of the workspace with its edge, in metres."""
    low, high = np.transpose([settings.workspace_x, settings.workspace_y])
    return low - settings.edge_m, high + settings.edge_m


def same(one: Body, other: Body) -> bool:
    """Whether the centre of one lies within the other's rectangle: two masks on one object."""
    return _within(one.centre, other) or _within(other.centre, one)


def _within(point: np.ndarray, body: Body) -> bool:
    cosine, sine = np.cos(body.yaw), np.sin(body.yaw)
    along, across = np.array([[cosine, sine], [-sine, cosine]]) @ (point - body.centre)
    return bool(abs(along) <= body.sides[0] / 2 and abs(across) <= body.sides[1] / 2)
