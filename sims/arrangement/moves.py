"""Pick and place: planned as a whole before the arm moves, then carried out step by step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sims.arrangement.cell import OPEN_M, Blocked, Cell
from sims.arrangement.cloud import Body
from sims.arrangement.grasps import Grasp, grasps, releases, wrapped
from sims.arrangement.planner import HOME, Planner

ABOVE = np.array([0.0, 0.0, 0.1])
"""The hand is this far above its grasp before and after it, in metres."""
OVER_M = 0.02
"""A carried body passes this far above the others."""
EMPTY_M = 0.008
"""Fingers closer than this hold nothing."""
SLOW = 0.35
"""Share of the full speed at which the hand goes down to a body and puts it down."""
ESCAPE_M, ESCAPE_STEP_M = 0.25, 0.03
"""Height to which the hand goes straight up after a failure, and distance of the points on its way."""


@dataclass(frozen=True)
class _Pick:
    grasp: Grasp
    approach: np.ndarray
    descend: np.ndarray


@dataclass(frozen=True)
class Plan:
    """Joint paths (N, 7) of one pick and place, one after the other."""

    grasp: Grasp
    release: Grasp
    approach: np.ndarray
    descend: np.ndarray
    lift: np.ndarray
    carry: np.ndarray
    lower: np.ndarray
    retreat: np.ndarray
    home: np.ndarray


class Picking:
    """All ways to pick up one body among others, found one by one and kept for several targets."""

    def __init__(self, planner: Planner, body: Body, others: Sequence[Body]) -> None:
        self.planner, self.body, self.others = planner, body, others
        self._found: list[_Pick] = []
        self._more = self._search()

    def to(self, target: Body) -> Plan | None:
        """The first pick and place, from the retracted arm and back, that touches nothing else; None: there is none.

        Raises:
            Exhausted: the planner may compare no more.
        """
        for pick in self._picks():
            for release in releases(self.body, pick.grasp, target):
                placed = self._place(pick, release)
                if placed is not None:
                    return placed
        return None

    @property
    def possible(self) -> bool:
        """Whether there is any way to pick it up."""
        return next(self._picks(), None) is not None

    def _picks(self) -> Iterator[_Pick]:
        yield from self._found
        for pick in self._more:
            self._found.append(pick)
            yield pick

    def _search(self) -> Iterator[_Pick]:
        for grasp in grasps(self.body):
            for turn in (0.0, np.pi):
                pick = self._pick(Grasp(grasp.point, wrapped(grasp.yaw + turn), grasp.width))
                if pick is not None:
                    yield pick

    def _pick(self, grasp: Grasp) -> _Pick | None:
        planner, above = self.planner, grasp.point + ABOVE
        planner.go_on()
        start = planner.reach(above, grasp.yaw)
        if start is None:
            return None
        planner.release()
        planner.show(self.others)
        descend = planner.straight(start, above, grasp.yaw, grasp.point, grasp.yaw, OPEN_M)
        if descend is None:
            return None
        planner.show([*self.others, self.body])
        approach = planner.swing(HOME, start, OPEN_M)
        return None if approach is None else _Pick(grasp, approach, descend)

    def _place(self, pick: _Pick, release: Grasp) -> Plan | None:
        """Lift, carry, lower, retreat and home; None if one of them is not free."""
        planner, grasp, width = self.planner, pick.grasp, pick.grasp.width / 2
        planner.go_on()
        if planner.reach(release.point, release.yaw) is None:
            return None
        up = np.array([0.0, 0.0, max((other.height for other in self.others), default=0.0) + OVER_M])
        planner.show(self.others)
        planner.hold(self.body, grasp.point, grasp.yaw)
        try:
            lift = planner.straight(pick.descend[-1], grasp.point, grasp.yaw, grasp.point + up, grasp.yaw, width)
            carry = None if lift is None else _carry(planner, lift[-1], grasp, release, up, width)
            if lift is None or carry is None:
                return None
            lower = planner.straight(carry[-1], release.point + up, release.yaw, release.point, release.yaw, width)
        finally:
            planner.release()
        if lower is None:
            return None
        retreat = planner.straight(lower[-1], release.point, release.yaw, release.point + ABOVE, release.yaw, OPEN_M)
        home = None if retreat is None else planner.swing(retreat[-1], HOME, OPEN_M)
        if retreat is None or home is None:
            return None
        return Plan(grasp, release, pick.approach, pick.descend, lift, carry, lower, retreat, home)


def _carry(
    planner: Planner, start: np.ndarray, grasp: Grasp, release: Grasp, up: np.ndarray, width: float
) -> np.ndarray | None:
    """From above the grasp to above the release: by joint angles if that is free, else in a straight line."""
    end = planner.reach(release.point + up, release.yaw)
    if end is not None:
        path = planner.swing(start, end, width)
        if path is not None:
            return path
    return planner.straight(start, grasp.point + up, grasp.yaw, release.point + up, release.yaw, width)


def carry_out(cell: Cell, planner: Planner, plan: Plan, note: Callable[[str], None]) -> str | None:
    """Carry out a plan; the arm is retracted afterwards, whatever happens.

    Returns:
        None if the body was let go at its place, else "no grip", "lost" (on the way) or "blocked".
    """
    try:
        note("approach")
        cell.grip(OPEN_M)
        cell.follow(plan.approach)
        note("grasp")
        cell.follow(plan.descend, SLOW)
        cell.grip(0.0)
        note("lift")
        cell.follow(plan.lift, SLOW)
        if cell.width() < EMPTY_M:
            escape(cell, planner)
            return "no grip"
        note("carry")
        cell.follow(plan.carry)
        note("place")
        cell.follow(plan.lower, SLOW)
        lost = cell.width() < EMPTY_M
        cell.grip(OPEN_M)
        note("retreat")
        cell.follow(plan.retreat, SLOW)
        cell.follow(plan.home)
        return "lost" if lost else None
    except Blocked:
        note("blocked")
        escape(cell, planner)
        return "blocked"


def escape(cell: Cell, planner: Planner) -> None:
    """Let go, go up and home, whatever is in the way."""
    cell.grip(OPEN_M)
    path = [cell.joints()]
    point, yaw = planner.where(path[0])
    for height in np.arange(point[2] + ESCAPE_STEP_M, ESCAPE_M + ESCAPE_STEP_M, ESCAPE_STEP_M).tolist():
        angles = planner.reach(np.array([*point[:2], height]), yaw, path[-1])
        if angles is None:
            break
        path.append(angles)
    cell.follow(np.array(path), SLOW, stubborn=True)
    cell.follow(np.array([cell.joints(), HOME]), SLOW, stubborn=True)
