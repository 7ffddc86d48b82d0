"""Training batches: a function of seed and step, every video equally often, no batch short."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apex_lab.data.batches import Clip, ShortClips, TrainBatches

SHORT = st.none() | st.builds(
    ShortClips, frames=st.integers(1, 6), batch_size=st.integers(1, 12), steps=st.integers(1, 40)
)
FRAMES = 6


def numbers(batches: TrainBatches) -> list[int]:
    return [entry.video if isinstance(entry, Clip) else entry for batch in batches for entry in batch]


@given(st.integers(1, 40), st.integers(1, 12), st.integers(0, 5), st.integers(0, 60), st.integers(0, 30), SHORT)
def test_going_on_at_any_step_gives_the_batches_of_an_unbroken_run(
    size: int, batch_size: int, seed: int, start: int, more: int, short: ShortClips | None
):
    unbroken = list(TrainBatches(size, FRAMES, batch_size, seed, 0, start + more, short))
    resumed = TrainBatches(size, FRAMES, batch_size, seed, start, start + more, short)
    assert list(resumed) == unbroken[start:]
    assert len(resumed) == more
    first = short["steps"] if short else 0
    assert all(len(batch) == batch_size for batch in unbroken[first:])
    kind = Clip if short else int
    assert all(isinstance(entry, kind) for batch in unbroken for entry in batch)
    assert all(entry[1:] == (0, FRAMES) for batch in unbroken[first:] for entry in batch if isinstance(entry, Clip))
    for batch in unbroken[:first]:
        assert short is not None
        assert len(batch) == short["batch_size"]
        assert all(
            clip.frames == short["frames"] and 0 <= clip.start <= FRAMES - short["frames"]
            for clip in batch
            if isinstance(clip, Clip)
        )


@given(st.integers(1, 30), st.integers(1, 12), st.integers(0, 5), SHORT)
def test_every_epoch_takes_every_video_once(size: int, batch_size: int, seed: int, short: ShortClips | None):
    row = numbers(TrainBatches(size, FRAMES, batch_size, seed, 0, 3 * size, short))
    for epoch in range(len(row) // size):
        assert Counter(row[epoch * size : (epoch + 1) * size]) == Counter(range(size))


def test_epochs_and_seeds_have_orders_of_their_own():
    rows = {tuple(TrainBatches(50, FRAMES, 50, seed, 0, 4).batch(epoch)) for seed in range(3) for epoch in range(4)}
    assert len(rows) == 12


def test_short_clips_start_anywhere_with_equal_chances():
    batches = TrainBatches(100, 5, 2, 0, 0, 200, ShortClips(frames=2, batch_size=10, steps=200))
    starts = Counter(clip.start for batch in batches for clip in batch if isinstance(clip, Clip))
    assert starts.keys() == {0, 1, 2, 3}
    assert all(abs(count - 500) < 5 * (2000 * 0.25 * 0.75) ** 0.5 for count in starts.values())


@pytest.mark.parametrize("start", [5, 7])
def test_nothing_is_left_after_the_last_step(start: int):
    batches = TrainBatches(10, FRAMES, 2, 0, start, 5)
    assert list(batches) == []
    assert len(batches) == 0


def test_a_batch_is_what_a_reader_computes_by_hand():
    order = (
        np.random.default_rng([7, 0]).permutation(4).tolist() + np.random.default_rng([7, 1]).permutation(4).tolist()
    )
    batches = TrainBatches(4, 3, 2, 7, 0, 3, ShortClips(frames=3, batch_size=3, steps=1))
    assert list(batches) == [
        [Clip(order[0], 0, 3), Clip(order[1], 0, 3), Clip(order[2], 0, 3)],
        [Clip(order[3], 0, 3), Clip(order[4], 0, 3)],
        [Clip(order[5], 0, 3), Clip(order[6], 0, 3)],
    ]
