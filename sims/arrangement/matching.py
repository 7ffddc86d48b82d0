"""Matching of current and goal detections by appearance."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist


def match(current: list[np.ndarray], goal: list[np.ndarray]) -> list[tuple[int, int]]:
    """One-to-one pairs (current, goal) with the smallest sum of L2 distances (Hungarian assignment).

    Args:
        current, goal: (D,) appearance vectors; one that holds a value that is not finite matches last.

    Returns:
        min(len(current), len(goal)) pairs, in the order of `current`.

    Raises:
        ValueError: the vectors have several lengths.
    """
    if not current or not goal:
        return []
    lengths = {vector.shape for vector in (*current, *goal)}
    if len(lengths) > 1:
        raise ValueError(f"appearance vectors must have one shape, not {sorted(lengths)}")
    with np.errstate(over="ignore", invalid="ignore"):
        cost = cdist(np.stack(current).astype(np.float64), np.stack(goal).astype(np.float64))
    known = np.isfinite(cost)
    # Larger than any sum of known distances, so that the known ones decide first.
    cost = np.where(known, cost, 1.0 + 2 * cost[known].sum() if known.any() else 1.0)
    rows, columns = linear_sum_assignment(cost)
    return [(int(row), int(column)) for row, column in zip(rows, columns, strict=True)]
