"""Training batches: a function of seed and step, every video equally often, no batch short."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apex_lab.data.batches import TrainBatches


@given(st.integers(1, 40), st.integers(1, 12), st.integers(0, 5), st.integers(0, 60), st.integers(0, 30))
def test_going_on_at_any_step_gives_the_batches_of_an_unbroken_run(
    size: int, batch_size: int, seed: int, start: int, more: int
):
    unbroken = list(TrainBatches(size, batch_size, seed, 0, start + more))
    resumed = TrainBatches(size, batch_size, seed, start, start + more)
    assert list(resumed) == unbroken[start:]
    assert len(resumed) == more
    assert all(len(batch) == batch_size for batch in unbroken)


@given(st.integers(1, 30), st.integers(1, 12), st.integers(0, 5))
def test_every_epoch_takes_every_video_once(size: int, batch_size: int, seed: int):
    steps = 3 * size
    row = [index for batch in TrainBatches(size, batch_size, seed, 0, steps) for index in batch]
    for epoch in range(len(row) // size):
        assert Counter(row[epoch * size : (epoch + 1) * size]) == Counter(range(size))


def test_epochs_and_seeds_have_orders_of_their_own():
    rows = {tuple(TrainBatches(50, 50, seed, 0, 4).batch(epoch)) for seed in range(3) for epoch in range(4)}
    assert len(rows) == 12


@pytest.mark.parametrize("start", [5, 7])
def test_nothing_is_left_after_the_last_step(start: int):
    batches = TrainBatches(10, 2, 0, start, 5)
    assert list(batches) == []
    assert len(batches) == 0
