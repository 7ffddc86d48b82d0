"""Training clips: a function of seed and step, every video equally often, no batch short, ranks that share a batch."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apex_lab.base.errors import UserError
from apex_lab.data import Clip, ClipSampler


def sampler(size: int, batch_size: int, seed: int, start: int, stop: int) -> ClipSampler:
    """Whole videos of a set of `size`."""
    return ClipSampler([3] * size, batch_size, seed, start, stop)


@given(st.integers(1, 40), st.integers(1, 12), st.integers(0, 5), st.integers(0, 60), st.integers(0, 30))
def test_resuming_at_any_step_gives_the_batches_of_an_unbroken_run(
    size: int, batch_size: int, seed: int, start: int, more: int
):
    unbroken = list(sampler(size, batch_size, seed, 0, start + more))
    resumed = sampler(size, batch_size, seed, start, start + more)
    assert list(resumed) == unbroken[start:]
    assert len(resumed) == more
    assert all(len(batch) == batch_size for batch in unbroken)


@given(st.integers(1, 40), st.integers(1, 12), st.integers(0, 5), st.integers(0, 60), st.integers(0, 30))
def test_clips_are_those_of_an_unbroken_run_too(size: int, batch_size: int, seed: int, start: int, more: int):
    def clips(first: int) -> ClipSampler:
        lengths = [4 + i % 3 for i in range(size)]
        return ClipSampler(lengths, batch_size, seed, first, start + more, lambda step: 1 + step % 4, views=2)

    unbroken = list(clips(0))
    assert list(clips(start)) == unbroken[start:]
    for step, batch in enumerate(unbroken):
        for clip in batch:
            assert clip.frames == 1 + step % 4
            assert 0 <= clip.start <= 4 + clip.video % 3 - clip.frames
            assert clip.view in (0, 1)


@given(st.integers(1, 30), st.integers(1, 12), st.integers(0, 5))
def test_every_epoch_takes_every_video_once(size: int, batch_size: int, seed: int):
    steps = 3 * size
    row = [clip for batch in sampler(size, batch_size, seed, 0, steps) for clip in batch]
    for epoch in range(len(row) // size):
        assert Counter(row[epoch * size : (epoch + 1) * size]) == Counter(Clip(i) for i in range(size))


def test_short_clips_begin_at_every_frame_that_leaves_room_equally_often():
    batches = ClipSampler([5] * 10, 100, 0, 0, 10, lambda step: 3)
    starts = Counter(clip.start for batch in batches for clip in batch)
    assert starts.keys() == {0, 1, 2}
    assert all(abs(count - 1000 / 3) < 5 * (1000 * 2 / 9) ** 0.5 for count in starts.values())


def test_epochs_and_seeds_have_orders_of_their_own():
    rows = {tuple(sampler(50, 50, seed, 0, 4).batch(epoch)) for seed in range(3) for epoch in range(4)}
    assert len(rows) == 12


@pytest.mark.parametrize("start", [5, 7])
def test_nothing_is_left_after_the_last_step(start: int):
    batches = sampler(10, 2, 0, start, 5)
    assert list(batches) == []
    assert len(batches) == 0


@pytest.mark.parametrize("ranks", [1, 2, 3])
def test_ranks_share_every_batch_in_order(ranks: int):
    alone = list(ClipSampler([5] * 7, 6, 0, 2, 8, lambda step: 2))
    each = [list(ClipSampler([5] * 7, 6, 0, 2, 8, lambda step: 2, rank=r, ranks=ranks)) for r in range(ranks)]
    assert [[clip for part in parts for clip in part] for parts in zip(*each, strict=True)] == alone


def test_what_cannot_be_drawn_is_refused():
    with pytest.raises(UserError, match=r"clips.batch_size = 6 cannot be shared equally among 4 processes\."):
        ClipSampler([5], 6, 0, 0, 1, ranks=4)
    with pytest.raises(UserError, match=r"clips.frames is 4 at step 3, but the shortest training video has 3 frames"):
        ClipSampler([5, 3], 2, 0, 0, 6, lambda step: step + 1)


@given(st.lists(st.integers(5, 23), min_size=1, max_size=6), st.integers(1, 12), st.integers(0, 3))
def test_disjoint_clips_cut_every_video_into_pieces_that_come_once_an_epoch(
    lengths: list[int], batch_size: int, seed: int
):
    pieces = [Clip(video, 5 * i, 5) for video, length in enumerate(lengths) for i in range(length // 5)]
    batches = ClipSampler(lengths, batch_size, seed, 0, 2 * len(pieces), lambda step: 5, starts="disjoint")
    row = [clip for batch in batches for clip in batch]
    for epoch in range(len(row) // len(pieces)):
        assert Counter(row[epoch * len(pieces) : (epoch + 1) * len(pieces)]) == Counter(pieces)


def test_a_video_of_twenty_frames_is_four_clips_of_five():
    """op3.md section 1: 2,000 episodes are 8,000 clips, and 40,000 steps of 4 are 20 passes over them."""
    batches = ClipSampler([20] * 2000, 4, 0, 0, 2000, lambda step: 5, starts="disjoint")
    clips = Counter(clip for batch in batches for clip in batch)
    assert len(clips) == 8000
    assert set(clips.values()) == {1}
    assert {clip.start for clip in clips} == {0, 5, 10, 15}


def test_disjoint_clips_resume_share_batches_and_draw_views():
    def clips(start: int, **options: int) -> list[list[Clip]]:
        return list(ClipSampler([7] * 5, 4, 1, start, 9, lambda step: 2 + step // 5, 2, starts="disjoint", **options))

    assert clips(3) == clips(0)[3:]
    assert [a + b for a, b in zip(clips(0, rank=0, ranks=2), clips(0, rank=1, ranks=2), strict=True)] == clips(0)
    assert {clip.view for batch in clips(0) for clip in batch} == {0, 1}
    assert clips(0) != list(ClipSampler([7] * 5, 4, 1, 0, 9, lambda step: 2 + step // 5, 2))


def test_whole_videos_have_no_starts():
    assert list(ClipSampler([7] * 5, 4, 1, 0, 9, starts="disjoint")) == list(ClipSampler([7] * 5, 4, 1, 0, 9))
