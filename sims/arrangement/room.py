"""Room on the table: whether a place is free, who stands in whose way, and free places at the edge."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from sims.arrangement.cloud import Body
from sims.arrangement.grasps import hands
from sims.arrangement.moves import Picking
from sims.arrangement.planner import Planner
from sims.arrangement.scene import bounds
from sims.arrangement.settings import Settings
from sims.arrangement.types import View
from sims.rectangles import separate

CLEAR_M = 0.012
"""A target is free if no other body comes nearer to the object's rectangle there: the planner's distances and what a
pixel can err."""
APART_M = 0.03
"""Distance of a place at the edge from other bodies and from goals."""
GRID_M = 0.03
SHOWN_PX = 1.0
IDLE = 2
"""Rank of a body that is in nobody's way."""


def is_free(body: Body, target: Body, others: Sequence[Body]) -> bool:
    """Whether an object would stand apart from all others at its target, turned as there or as it is."""
    there = replace(body, centre=target.centre, yaw=target.yaw)
    return all(separate(there.outline, other.outline, CLEAR_M) for other in others)


def has_room(body: Body, others: Sequence[Body]) -> bool:
    """Whether the hand can go down to a body without touching others."""
    around = hands(body.centre, body.sides, body.yaw)
    return any(all(separate(hand, other.outline, CLEAR_M) for other in others) for hand in around)


class Ways:
    """Who stands in whose way, in one image.

    Args:
        picking: of the object of each goal that is not reached.
        targets: of these goals.
        dropped: goals that are tried no more.
    """

    def __init__(
        self, planner: Planner, picking: dict[int, Picking], targets: dict[int, Body], dropped: set[int]
    ) -> None:
        self.planner, self.picking, self.targets, self.dropped = planner, picking, targets, dropped
        self.shut = {goal: self._shut(goal) for goal in picking}
        """Goal -> goals whose objects the hand could not take any more if this goal's object were there."""

    def _shut(self, goal: int) -> set[int]:
        body, target = self.picking[goal].body, self.targets[goal]
        found = set()
        for other, each in self.picking.items():
            if other != goal and not has_room(each.body, [target]) and each.possible:
                then = [one for one in each.others if one is not body] + [target]
                if not Picking(self.planner, each.body, then).possible:
                    found.add(other)
        return found

    def rank(self, goal: int | None, body: Body) -> int:
        """How much a body, with its goal, is in the way of other objects: 0 if it alone stands on a target or keeps the
        hand away from one, 1 if others do so too, `IDLE` if it does not."""
        rank = IDLE
        for other, each in self.picking.items():
            if goal == other or other in self.dropped or not any(body is one for one in each.others):
                continue
            target = self.targets[other]
            rest = [one for one in each.others if one is not body]
            taken = not is_free(each.body, target, [body]) or goal in self.shut[other]
            if taken or not has_room(each.body, [body]) or not has_room(target, [body]):
                rank = min(rank, 1)
                alone = is_free(each.body, target, rest)
                if alone and (taken or Picking(self.planner, each.body, rest).to(target) is not None):
                    return 0
        return rank


def edge_places(
    settings: Settings, view: View, body: Body, around: Sequence[Body], still: Sequence[Body]
) -> Iterator[Body]:
    """Places for a body, those at the edge first, the nearest first.

    Args:
        view: an image of the camera, which must see the body there.
        around: other bodies and targets, from which a place is apart.
        still: bodies that are to be moved yet: a place leaves the hand room at them.
    """
    low, high = bounds(settings)
    xs, ys = (np.arange(a, b + 1e-9, GRID_M) for a, b in zip(low, high, strict=True))
    grid = np.array([(x, y) for x in xs for y in ys])
    inner = ((grid > low + settings.edge_m / 2) & (grid < high - settings.edge_m / 2)).all(axis=1)
    far = np.linalg.norm(grid - body.centre, axis=1)
    for number in np.lexsort([far, inner]):
        place = replace(body, centre=grid[number])
        free = all(separate(place.outline, other.outline, APART_M) for other in around)
        room = free and has_room(place, around) and all(has_room(one, [place]) for one in still)
        if room and _visible(view, place):
            yield place


def _visible(view: View, place: Body) -> bool:
    size = view.depth.shape[0]
    corners = np.array([[*corner, z] for corner in place.outline for z in (0.0, place.height)])
    pixels, _ = view.camera.project(corners, size)
    return bool((pixels >= SHOWN_PX).all() and (pixels <= size - SHOWN_PX).all())
