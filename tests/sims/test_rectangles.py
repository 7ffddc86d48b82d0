"""Gaps of many rectangles against the test of one pair."""

from __future__ import annotations

import numpy as np

from sims.rectangles import Rectangles, rectangle, separate


def _drawn(rng: np.random.Generator, count: int) -> Rectangles:
    return Rectangles(
        rng.uniform(-0.2, 0.2, (count, 2)), rng.uniform(0.02, 0.2, (count, 2)), rng.uniform(-np.pi, np.pi, count)
    )


def test_gaps_agree_with_separate() -> None:
    rng = np.random.default_rng(0)
    many, others = _drawn(rng, 40), _drawn(rng, 7)
    gaps = many.gaps(others)
    assert gaps.shape == (40, 7)
    corners = [[rectangle(*row) for row in zip(r.centres, r.sides, r.yaws, strict=True)] for r in (many, others)]
    for margin in (0.0, 0.03):
        expected = [[separate(one, other, margin) for other in corners[1]] for one in corners[0]]
        np.testing.assert_array_equal(gaps >= margin, expected)
    assert 0.2 < (gaps >= 0).mean() < 0.9
    assert many.gaps(others[:0]).shape == (40, 0)


def test_joined_rectangles_keep_their_order() -> None:
    rng = np.random.default_rng(1)
    one, two = _drawn(rng, 2), _drawn(rng, 1)
    both = one.joined(two)
    np.testing.assert_array_equal(both.centres, [*one.centres, *two.centres])
    np.testing.assert_array_equal(both[2:].yaws, two.yaws)
