"""What is where: which object of the current image belongs to which goal, and which goals are reached."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sims.arrangement.cloud import Body
from sims.arrangement.matching import match
from sims.arrangement.scene import Item, Scene

Kind = Literal["home", "aside"]


@dataclass
class Attempt:
    """A sub-task under way.

    Attributes:
        goal: index of the goal item; None for an object without a goal.
        body, place: where the object is and where it shall be.
        attempts: made so far.
        failure: of the last.
        started_s: simulated time at the start of the first.
        point: (3,) of the last grasp.
    """

    goal: int | None
    kind: Kind
    body: Body
    place: Body
    attempts: int = 0
    failure: str | None = None
    started_s: float = 0.0
    ended_s: float = 0.0
    point: np.ndarray | None = None


@dataclass
class GoalState:
    """Progress of one goal."""

    done: bool = False
    visits: int = 0
    asides: int = 0


class Progress:
    """Of a rearrangement, as far as images show it.

    Args:
        goal: the goal image understood.
        reached_m: an object seen this near its goal has arrived.
    """

    def __init__(self, goal: Scene, reached_m: float) -> None:
        self.goal, self.reached_m = goal, reached_m
        self.states = [GoalState() for _ in goal.items]
        self.scene: Scene | None = None
        """The last image understood."""
        self.matches: list[tuple[int, int]] = []
        """Pairs (item of the scene, item of the goal)."""

    @property
    def arranged(self) -> bool:
        """Whether every object that has a match is at its goal."""
        return all(self.states[goal].done for _, goal in self.matches)

    def target(self, goal: int) -> Body:
        """The goal's place."""
        return self.goal.items[goal].body

    def update(self, scene: Scene) -> None:
        """Take in a new image. Objects that have arrived keep their goals; the others are matched by appearance."""
        pairs: list[tuple[int, int]] = []
        for number, state in enumerate(self.states):
            if state.done:
                near = self._nearest(scene, self.target(number), {item for item, _ in pairs})
                state.done = near is not None
                if near is not None:
                    pairs.append((near, number))
        items = [i for i in range(len(scene.items)) if i not in {item for item, _ in pairs}]
        goals = [g for g in range(len(self.states)) if not self.states[g].done]
        found = match([scene.items[i].appearance for i in items], [self.goal.items[g].appearance for g in goals])
        pairs += [(items[row], goals[column]) for row, column in found]
        for item, goal in pairs:
            self.states[goal].done |= apart(scene.items[item].body, self.target(goal)) <= self.reached_m
        self.scene, self.matches = scene, pairs

    def open(self) -> list[tuple[int, Item]]:
        """Goals that are not reached, with their objects."""
        assert self.scene is not None
        return [(goal, self.scene.items[item]) for item, goal in self.matches if not self.states[goal].done]

    def item(self, goal: int) -> Item | None:
        """The object that is matched with a goal."""
        assert self.scene is not None
        return next((self.scene.items[item] for item, number in self.matches if number == goal), None)

    def bodies(self) -> list[tuple[int | None, Body]]:
        """All bodies of the image, each with its goal; None: without."""
        assert self.scene is not None
        owner = dict(self.matches)
        seen: list[tuple[int | None, Body]] = [(owner.get(i), item.body) for i, item in enumerate(self.scene.items)]
        return seen + [(None, body) for body in self.scene.strangers]

    def _nearest(self, scene: Scene, place: Body, taken: set[int]) -> int | None:
        """The item at a place, of those not taken."""
        distance = {i: apart(item.body, place) for i, item in enumerate(scene.items) if i not in taken}
        best = min(distance, key=distance.__getitem__, default=None)
        return best if best is not None and distance[best] <= self.reached_m else None


def apart(body: Body, place: Body) -> float:
    """Distance of two centres in metres."""
    return float(np.linalg.norm(body.centre - place.centre))
