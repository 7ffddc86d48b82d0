"""Where the gripper can take a body, and where it puts it down."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sims.arrangement.cloud import Body
from sims.rectangles import rectangle

WIDEST_M = 0.074
"""Widest body between the fingers, which open to 80 mm."""
PAD_M = 0.012
"""Half the width of a finger along the body."""
DEPTHS_M, LOWEST_M = (0.033, 0.018), 0.014
"""The point between the fingertips lies this far below the body's top, the second where neighbours leave the hand no
room, but not lower than this above the table: the palm is 39 mm above it, the tips 7 mm below."""
HAND_M = (0.07, 0.225)
"""Rectangle of the open hand seen from above: along and across the plane between the fingers."""
ROUND = 1.15
"""Ratio of the sides up to which a body may be taken in any direction."""
SQUARE = 1.3
"""Ratio of the sides from which a body has a long side: below, it is not turned to lie as in the goal image."""
RELEASE_M = 0.002
"""A body is let go this far above where it stood."""


@dataclass(frozen=True)
class Grasp:
    """The hand at a body.

    Attributes:
        point: (3,) metres, between the fingertips.
        yaw: of the hand in radians; the fingers open perpendicular to it.
        width: of the body between the fingers in metres.
    """

    point: np.ndarray
    yaw: float
    width: float


def turns_of(sides: tuple[float, float]) -> list[float]:
    """Angles between a body's long side and the hand's yaw, the best first: all around for a round body."""
    if sides[0] < ROUND * sides[1]:
        return [number * np.pi / 6 for number in (0, 3, 1, 5, 2, 4)]
    return [0.0, np.pi / 2]


def hands(centre: np.ndarray, sides: tuple[float, float], yaw: float) -> list[np.ndarray]:
    """Rectangles (4, 2) of the hand above a body that fits between its fingers."""
    turns = [turn for turn in turns_of(sides) if turn == 0 or max(sides) <= WIDEST_M]
    return [rectangle(centre, HAND_M, yaw + turn) for turn in turns]


def grasps(body: Body) -> list[Grasp]:
    """Grasps that fit between the fingers, the best first: across the narrow side, else at right angles; all around a
    round body. Empty if the body is too wide."""
    return [
        grasp
        for depth in DEPTHS_M
        for turn in turns_of(body.sides)
        if (grasp := _across(body, body.yaw + turn, depth)) is not None
    ]


def _across(body: Body, yaw: float, depth: float) -> Grasp | None:
    """The grasp at the middle of the body, by the width of the slice that the fingers touch."""
    along, across = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    flat = body.points[:, :2] - body.centre
    lengthwise, sideways = flat @ along, flat @ across
    middle = (lengthwise.min() + lengthwise.max()) / 2
    near = np.abs(lengthwise - middle) <= PAD_M
    if not near.any():
        return None
    low, high = float(sideways[near].min()), float(sideways[near].max())
    width = high - low + body.pixel
    if width > WIDEST_M:
        return None
    point = body.centre + middle * along + (low + high) / 2 * across
    return Grasp(np.array([*point, max(LOWEST_M, body.height - depth)]), wrapped(yaw), width)


def releases(body: Body, grasp: Grasp, target: Body) -> list[Grasp]:
    """Poses of the hand that put a grasped body where `target` is, the preferred first.

    The body is turned so that its long side lies as the target's, either way round; as a last resort it is not turned.
    """
    turns = [0.0, np.pi]
    if min(body.sides[0] / body.sides[1], target.sides[0] / target.sides[1]) >= SQUARE:
        turn = wrapped(target.yaw - body.yaw)
        turns = [turn, wrapped(turn + np.pi)] + (turns if abs(np.sin(turn)) > 1e-6 else [])
    return [_turned(body, grasp, target.centre, turn) for turn in turns]


def _turned(body: Body, grasp: Grasp, centre: np.ndarray, turn: float) -> Grasp:
    """The hand after a turn of the body by `turn` radians and a move of its centre."""
    cosine, sine = np.cos(turn), np.sin(turn)
    shift = np.array([[cosine, -sine], [sine, cosine]]) @ (grasp.point[:2] - body.centre)
    return Grasp(np.array([*(centre + shift), grasp.point[2] + RELEASE_M]), grasp.yaw + turn, grasp.width)


def wrapped(angle: float) -> float:
    """An angle in [-pi, pi)."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
