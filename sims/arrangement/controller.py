"""The heuristic controller: which object to move next, where to, and whether it arrived.

It knows what perception finds in images without the arm, and its own arm; nothing of the simulator.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sims.arrangement.cell import Cell
from sims.arrangement.cloud import Body
from sims.arrangement.grasps import hands
from sims.arrangement.matching import match
from sims.arrangement.moves import Picking, Plan, carry_out
from sims.arrangement.planner import Planner
from sims.arrangement.scene import Item, Scene, bounds
from sims.arrangement.settings import Settings
from sims.arrangement.types import Ended
from sims.rectangles import separate

CLEAR_M = 0.012
"""A target is free if no other body comes nearer to the object's rectangle there: the planner's distances and what a
pixel can err."""
APART_M = 0.03
"""Distance of a place at the edge from other bodies and from goals."""
GRID_M = 0.03
ASIDE_M = 0.04
"""An object put aside counts as moved if it is seen this near its place."""
ASIDES = 2
"""Times one object is put aside."""
VISITS = 3
"""Sub-tasks that bring one object home: more than one if it was moved after it had arrived, or found no way."""
PLACES = 12
"""Places at the edge that are planned for one object, the nearest first."""
SHOWN_PX = 1.0
IDLE = 2

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


class Controller:
    """Rearranges one table.

    Args:
        goal: the goal image understood.
        look: takes an image of the table, the arm being retracted, and perceives it.
        watch: called before and after every attempt.
        note: called with every phase.
    """

    def __init__(
        self,
        settings: Settings,
        cell: Cell,
        planner: Planner,
        goal: Scene,
        look: Callable[[], Scene],
        limit_s: float,
        watch: Callable[[Attempt, bool], None],
        note: Callable[[str], None],
    ) -> None:
        self.settings, self.cell, self.planner, self.goal = settings, cell, planner, goal
        self.look, self.limit_s, self.watch, self.note = look, limit_s, watch, note
        self.states = [GoalState() for _ in goal.items]
        self.finished: list[Attempt] = []
        self.current: Attempt | None = None
        self.scene: Scene | None = None
        self.matches: list[tuple[int, int]] = []
        """Pairs (item of the scene, item of the goal)."""
        self.moved_strangers = 0

    def arrange(self) -> Ended:
        """Move objects until all are at their goals or nothing more can be done."""
        while True:
            self.scene = self.look()
            self.matches = self._match(self.scene)
            self._verify(self.scene)
            if not self.matches:
                self._close()
                return "nothing detected"
            if all(self.states[goal].done for _, goal in self.matches):
                self._close()
                return "arranged"
            if self.cell.time_s > self.limit_s:
                self._close()
                return "out of time"
            chosen = self._next(self.scene)
            if chosen is None:
                self._close()
                return "stuck"
            self._attempt(*chosen)

    # --- what is where

    def _match(self, scene: Scene) -> list[tuple[int, int]]:
        """Objects that have arrived keep their goals; the others are matched by appearance."""
        pairs: list[tuple[int, int]] = []
        for number, state in enumerate(self.states):
            if state.done:
                near = self._nearest(scene, self.goal.items[number].body, {item for item, _ in pairs})
                state.done = near is not None
                if near is not None:
                    pairs.append((near, number))
        items = [i for i in range(len(scene.items)) if i not in {item for item, _ in pairs}]
        goals = [g for g in range(len(self.states)) if not self.states[g].done]
        found = match([scene.items[i].appearance for i in items], [self.goal.items[g].appearance for g in goals])
        pairs += [(items[row], goals[column]) for row, column in found]
        for item, goal in pairs:
            self.states[goal].done |= self._away(scene.items[item].body, self.goal.items[goal].body) <= self._reached
        return pairs

    @property
    def _reached(self) -> float:
        return self.settings.reached_m

    def _nearest(self, scene: Scene, place: Body, taken: set[int]) -> int | None:
        """The item at a place, of those not taken."""
        distance = {i: self._away(item.body, place) for i, item in enumerate(scene.items) if i not in taken}
        best = min(distance, key=distance.__getitem__, default=None)
        return best if best is not None and distance[best] <= self._reached else None

    @staticmethod
    def _away(body: Body, place: Body) -> float:
        return float(np.linalg.norm(body.centre - place.centre))

    def _item(self, scene: Scene, goal: int) -> Item | None:
        return next((scene.items[item] for item, number in self.matches if number == goal), None)

    # --- what to do

    def _next(self, scene: Scene) -> tuple[Attempt, Plan] | None:
        """A sub-task that can be planned: a retry, an object whose target is free, an object to put aside."""
        retry = self._retry(scene)
        if retry is not None:
            return retry
        picking = {goal: self._picking(scene, item.body) for goal, item in self._open(scene)}
        shut = {goal: self._shut(goal, picking) for goal in picking}
        chosen = self._home(picking, [goal for goal in picking if not shut[goal]])
        return (
            chosen or self._aside(scene, picking, shut) or self._home(picking, [goal for goal in picking if shut[goal]])
        )

    def _home(self, picking: dict[int, Picking], goals: list[int]) -> tuple[Attempt, Plan] | None:
        """The first of these goals whose target is free and can be reached; objects put aside come last."""
        for goal in sorted(goals, key=lambda goal: self.states[goal].asides):
            body, target, state = picking[goal].body, self.goal.items[goal].body, self.states[goal]
            if state.visits < VISITS and _is_free(body, target, picking[goal].others):
                path = picking[goal].to(target)
                if path is not None:
                    state.visits += 1
                    return Attempt(goal, "home", body, target), path
        return None

    def _picking(self, scene: Scene, body: Body) -> Picking:
        return Picking(self.planner, body, scene.others(body))

    def _shut(self, goal: int, picking: dict[int, Picking]) -> set[int]:
        """Goals whose objects the hand could not take any more if this goal's object were there."""
        body, target = picking[goal].body, self.goal.items[goal].body
        found = set()
        for other, each in picking.items():
            if other != goal and not _room(each.body, [target]) and each.possible:
                then = [one for one in each.others if one is not body] + [target]
                if not Picking(self.planner, each.body, then).possible:
                    found.add(other)
        return found

    def _retry(self, scene: Scene) -> tuple[Attempt, Plan] | None:
        """The current sub-task again; closes it if it is done, was tried often enough or cannot be planned."""
        attempt = self.current
        if attempt is None:
            return None
        if attempt.goal is not None and attempt.failure is not None and attempt.attempts < self.settings.max_attempts:
            item = self._item(scene, attempt.goal)
            if item is not None and _is_free(item.body, attempt.place, scene.others(item.body)):
                path = self._picking(scene, item.body).to(attempt.place)
                if path is not None:
                    attempt.body = item.body
                    return attempt, path
        self._close()
        return None

    def _open(self, scene: Scene) -> list[tuple[int, Item]]:
        """Goals that are not reached, with their objects."""
        return [(goal, scene.items[item]) for item, goal in self.matches if not self.states[goal].done]

    def _aside(
        self, scene: Scene, picking: dict[int, Picking], shut: dict[int, set[int]]
    ) -> tuple[Attempt, Plan] | None:
        """Make room: a body that stands on the open goal of another, blocks the way, or would be shut in, goes to the
        edge; else any unsorted object."""
        targets = {goal: self.goal.items[goal].body for goal in picking}
        owner = dict(self.matches)
        bodies = [(owner.get(number), item.body) for number, item in enumerate(scene.items)]
        bodies += [(None, body) for body in scene.strangers]
        ranks = [self._blocks(goal, body, picking, shut) for goal, body in bodies]
        for rank, goal, body in sorted(
            ((rank, goal, body) for rank, (goal, body) in zip(ranks, bodies, strict=True)), key=lambda each: each[0]
        ):
            if rank == IDLE and (goal is None or self.states[goal].done):
                continue
            if (self.moved_strangers if goal is None else self.states[goal].asides) >= ASIDES:
                continue
            found = self._to_edge(
                self._picking(scene, body),
                list(targets.values()),
                [each.body for other, each in picking.items() if other != goal],
            )
            if found is not None:
                place, path = found
                if goal is None:
                    self.moved_strangers += 1
                else:
                    self.states[goal].asides += 1
                    self.states[goal].done = False
                return Attempt(goal, "aside", body, place), path
        return None

    def _blocks(self, goal: int | None, body: Body, picking: dict[int, Picking], shut: dict[int, set[int]]) -> int:
        """How much a body is in the way of open objects: 0 if it alone stands on a target or keeps the hand away from
        one, 1 if others do so too, `IDLE` if it does not."""
        rank = IDLE
        for other, each in picking.items():
            if goal == other or not any(body is one for one in each.others) or self.states[other].visits >= VISITS:
                continue
            target = self.goal.items[other].body
            rest = [one for one in each.others if one is not body]
            taken = not _is_free(each.body, target, [body]) or goal in shut[other]
            if taken or not _room(each.body, [body]) or not _room(target, [body]):
                rank = min(rank, 1)
                alone = _is_free(each.body, target, rest)
                if alone and (taken or Picking(self.planner, each.body, rest).to(target) is not None):
                    return 0
        return rank

    def _to_edge(self, picking: Picking, targets: list[Body], still: list[Body]) -> tuple[Body, Plan] | None:
        """The nearest free place at the edge that can be reached, away from other bodies and from targets, and leaving
        the hand room at the bodies that are still to be moved."""
        low, high = bounds(self.settings)
        xs, ys = (np.arange(a, b + 1e-9, GRID_M) for a, b in zip(low, high, strict=True))
        grid = np.array([(x, y) for x in xs for y in ys])
        inner = ((grid > low + self.settings.edge_m / 2) & (grid < high - self.settings.edge_m / 2)).all(axis=1)
        far = np.linalg.norm(grid - picking.body.centre, axis=1)
        around = [*picking.others, *targets]
        tried = 0
        for number in np.lexsort([far, inner]):
            place = replace(picking.body, centre=grid[number])
            apart = all(separate(place.outline, other.outline, APART_M) for other in around)
            room = apart and _room(place, around) and all(_room(body, [place]) for body in still)
            if not room or not self._visible(place):
                continue
            path = picking.to(place)
            if path is not None:
                return place, path
            tried += 1
            if tried == PLACES:
                break
        return None

    def _visible(self, place: Body) -> bool:
        size = self.goal.view.depth.shape[0]
        corners = np.array([[*corner, z] for corner in place.outline for z in (0.0, place.height)])
        pixels, _ = self.goal.view.camera.project(corners, size)
        return bool((pixels >= SHOWN_PX).all() and (pixels <= size - SHOWN_PX).all())

    # --- doing it

    def _attempt(self, attempt: Attempt, path: Plan) -> None:
        if attempt is not self.current:
            self.current = attempt
            attempt.started_s = self.cell.time_s
        attempt.attempts += 1
        attempt.point = path.grasp.point
        self.watch(attempt, True)
        name = f"{attempt.kind}{'' if attempt.goal is None else f' {attempt.goal + 1}'}"
        attempt.failure = carry_out(self.cell, self.planner, path, lambda phase: self.note(f"{name}: {phase}"))
        attempt.ended_s = self.cell.time_s
        self.watch(attempt, False)

    def _verify(self, scene: Scene) -> None:
        """Compare the current sub-task's place with the new image, which decides whether it failed."""
        attempt = self.current
        if attempt is None:
            return
        reach = self._reached if attempt.kind == "home" else ASIDE_M
        if attempt.goal is not None:
            item = self._item(scene, attempt.goal)
            bodies = [] if item is None else [item.body]
        else:
            bodies = [item.body for item in scene.items] + list(scene.strangers)
        if any(self._away(body, attempt.place) <= reach for body in bodies):
            attempt.failure = None
        elif attempt.failure is None:
            attempt.failure = "not seen" if not bodies else "not at its place"

    def _close(self) -> None:
        if self.current is not None:
            self.finished.append(self.current)
        self.current = None


def _is_free(body: Body, target: Body, others: Sequence[Body]) -> bool:
    """Whether an object would stand apart from all others at its target, turned as there or as it is."""
    there = replace(body, centre=target.centre, yaw=target.yaw)
    return all(separate(there.outline, other.outline, CLEAR_M) for other in others)


def _room(body: Body, others: Sequence[Body]) -> bool:
    """Whether the hand can go down to a body without touching others."""
    around = hands(body.centre, body.sides, body.yaw)
    return any(all(separate(hand, other.outline, CLEAR_M) for other in others) for hand in around)
