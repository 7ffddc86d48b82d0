"""Matching against all permutations, and with values that are no numbers."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from sims.arrangement.matching import match


def test_the_sum_of_distances_is_the_smallest_of_all_assignments() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        current, goal = rng.normal(size=(4, 5)), rng.normal(size=(4, 5))
        best = min(
            sum(float(np.linalg.norm(current[i] - goal[j])) for i, j in enumerate(order))
            for order in permutations(range(4))
        )
        pairs = match(list(current), list(goal))
        assert sum(float(np.linalg.norm(current[i] - goal[j])) for i, j in pairs) == pytest.approx(best)


def test_the_shorter_side_is_matched_whole() -> None:
    vectors = list(np.eye(4))
    assert match(vectors[:2], vectors) == [(0, 0), (1, 1)]
    assert match(vectors, vectors[2:]) == [(2, 0), (3, 1)]
    assert match([], vectors) == match(vectors, []) == []


def test_vectors_that_are_not_finite_match_last() -> None:
    vectors = list(np.eye(3))
    broken = [np.array([np.nan, 0, 0]), vectors[1], np.array([np.inf, 0, 0]), vectors[0]]
    assert match(broken, vectors[:2]) == [(1, 1), (3, 0)]
    assert match([broken[0]], vectors) == [(0, match([broken[0]], vectors)[0][1])]


def test_vectors_of_several_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match="one shape"):
        match([np.zeros(3)], [np.zeros(4)])
