"""The heuristic controller: which object to move next, where to, and whether it arrived.

It knows what perception finds in images without the arm, and its own arm; nothing of the simulator.
"""

from __future__ import annotations

from collections.abc import Callable

from sims.arrangement.cell import Cell
from sims.arrangement.cloud import Body
from sims.arrangement.moves import Picking, Plan, carry_out
from sims.arrangement.planner import Exhausted, Planner
from sims.arrangement.progress import Attempt, Progress, apart
from sims.arrangement.room import IDLE, Ways, edge_places, is_free
from sims.arrangement.scene import Scene
from sims.arrangement.settings import Settings
from sims.arrangement.types import Ended

ASIDE_M = 0.04
"""An object put aside counts as moved if it is seen this near its place."""
ASIDES = 2
"""Times one object is put aside."""
VISITS = 3
"""Sub-tasks that bring one object home: more than one if it was moved after it had arrived, or found no way."""
PLACES = 12
"""Places at the edge that are planned for one object, the nearest first."""


class Controller:
    """Rearranges one table.

    Args:
        goal: the goal image understood.
        look: takes an image of the table, the arm being retracted, and perceives it.
        limit_s: simulated seconds after which no further sub-task is started.
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
        self.settings, self.cell, self.planner = settings, cell, planner
        self.look, self.limit_s, self.watch, self.note = look, limit_s, watch, note
        self.progress = Progress(goal, settings.reached_m)
        self.finished: list[Attempt] = []
        self.current: Attempt | None = None
        self.moved_strangers = 0

    def arrange(self) -> Ended:
        """Move objects until all are at their goals or nothing more can be done."""
        try:
            while True:
                self.progress.update(self.look())
                self._verify()
                if not self.progress.matches:
                    return "nothing detected"
                if self.progress.arranged:
                    return "arranged"
                if self.cell.time_s > self.limit_s:
                    return "out of time"
                chosen = self._next()
                if chosen is None:
                    return "stuck"
                self._attempt(*chosen)
        except Exhausted:
            return "out of time"
        finally:
            self._close()

    # --- what to do

    def _next(self) -> tuple[Attempt, Plan] | None:
        """A sub-task that can be planned: a retry, an object whose target is free, an object to put aside.

        Raises:
            Exhausted: the planner may compare no more.
        """
        retry = self._retry()
        if retry is not None:
            return retry
        progress = self.progress
        picking = {goal: self._picking(item.body) for goal, item in progress.open()}
        targets = {goal: progress.target(goal) for goal in picking}
        dropped = {goal for goal in picking if progress.states[goal].visits >= VISITS}
        ways = Ways(self.planner, picking, targets, dropped)
        chosen = self._home(ways, [goal for goal in picking if not ways.shut[goal]])
        return chosen or self._aside(ways) or self._home(ways, [goal for goal in picking if ways.shut[goal]])

    def _picking(self, body: Body) -> Picking:
        assert self.progress.scene is not None
        return Picking(self.planner, body, self.progress.scene.others(body))

    def _retry(self) -> tuple[Attempt, Plan] | None:
        """The current sub-task again; closes it if it is done, was tried often enough or cannot be planned."""
        attempt = self.current
        if attempt is None:
            return None
        if attempt.goal is not None and attempt.failure is not None and attempt.attempts < self.settings.max_attempts:
            item = self.progress.item(attempt.goal)
            picking = None if item is None else self._picking(item.body)
            if picking is not None and is_free(picking.body, attempt.place, picking.others):
                path = picking.to(attempt.place)
                if path is not None:
                    attempt.body = picking.body
                    return attempt, path
        self._close()
        return None

    def _home(self, ways: Ways, goals: list[int]) -> tuple[Attempt, Plan] | None:
        """The first of these goals whose target is free and can be reached; objects put aside come last."""
        for goal in sorted(goals, key=lambda goal: self.progress.states[goal].asides):
            picking, target = ways.picking[goal], ways.targets[goal]
            if goal not in ways.dropped and is_free(picking.body, target, picking.others):
                path = picking.to(target)
                if path is not None:
                    self.progress.states[goal].visits += 1
                    return Attempt(goal, "home", picking.body, target), path
        return None

    def _aside(self, ways: Ways) -> tuple[Attempt, Plan] | None:
        """Make room: a body that stands on the open goal of another, blocks the way, or would be shut in, goes to the
        edge; else any unsorted object."""
        bodies = self.progress.bodies()
        ranked = [(ways.rank(goal, body), goal, body) for goal, body in bodies]
        for rank, goal, body in sorted(ranked, key=lambda each: each[0]):
            state = None if goal is None else self.progress.states[goal]
            if rank == IDLE and (state is None or state.done):
                continue
            if (self.moved_strangers if state is None else state.asides) >= ASIDES:
                continue
            found = self._to_edge(ways, goal, body)
            if found is not None:
                place, path = found
                if state is None:
                    self.moved_strangers += 1
                else:
                    state.asides += 1
                    state.done = False
                return Attempt(goal, "aside", body, place), path
        return None

    def _to_edge(self, ways: Ways, goal: int | None, body: Body) -> tuple[Body, Plan] | None:
        """The nearest free place at the edge that can be reached, away from other bodies and from targets, and leaving
        the hand room at the bodies that are still to be moved."""
        picking = self._picking(body)
        still = [each.body for other, each in ways.picking.items() if other != goal]
        around = [*picking.others, *ways.targets.values()]
        places = edge_places(self.settings, self.progress.goal.view, body, around, still)
        for _, place in zip(range(PLACES), places, strict=False):
            path = picking.to(place)
            if path is not None:
                return place, path
        return None

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

    def _verify(self) -> None:
        """Compare the current sub-task's place with the new image, which decides whether it failed."""
        attempt = self.current
        if attempt is None:
            return
        reach = self.settings.reached_m if attempt.kind == "home" else ASIDE_M
        if attempt.goal is not None:
            item = self.progress.item(attempt.goal)
            bodies = [] if item is None else [item.body]
        else:
            bodies = [body for _, body in self.progress.bodies()]
        if any(apart(body, attempt.place) <= reach for body in bodies):
            attempt.failure = None
        elif attempt.failure is None:
            attempt.failure = "not seen" if not bodies else "not at its place"

    def _close(self) -> None:
        if self.current is not None:
            self.finished.append(self.current)
        self.current = None
