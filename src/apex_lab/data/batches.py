"""Which training videos make which batch: a function of (seed, step) alone, so that a run can go on at any step."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field
from torch.utils.data import Sampler
from typing_extensions import TypedDict  # pydantic takes Python's own from 3.12 on only

Count = Annotated[int, Field(gt=0)]


class Clip(NamedTuple):
    """A stretch of one video: its number, the first frame and how many."""

    video: int
    start: int
    frames: int


class ShortClips(TypedDict):
    """Batches of many short clips for the first steps of a training, before whole videos.

    Neighbouring frames are nearly alike: 8 clips of 2 frames show more than 2 videos of 8, at the same cost. A compiled
    model compiles anew where they end. A run that is no longer than `steps` never sees a whole video.

    frames: length of a clip; its first frame is drawn. batch_size: clips per step, each from the next video.
    steps: how many steps they last.
    """

    frames: Count
    batch_size: Count
    steps: Count


class TrainBatches(Sampler[list[int] | list[Clip]]):
    """Batches for the steps from `start_step` up to `max_steps`.

    The videos of all epochs form one endless row, each epoch in an order drawn from (seed, epoch); each step takes the
    next stretch of it. So every video is used equally often, no batch is short, and nothing needs to be remembered to
    go on.

    Args:
        size: number of videos.
        frames: of each video.
        batch_size: whole videos per step.
        seed: of the order and of the clips' first frames.
        start_step: step of the first batch.
        max_steps: step before which the batches end.
        short: clips of the first steps; None: whole videos from the start, and batches are plain numbers of videos.
    """

    def __init__(
        self,
        size: int,
        frames: int,
        batch_size: int,
        seed: int,
        start_step: int,
        max_steps: int,
        short: ShortClips | None = None,
    ) -> None:
        self.size, self.frames, self.batch_size, self.seed = size, frames, batch_size, seed
        self.start_step, self.max_steps, self.short = start_step, max_steps, short
        self._order = lru_cache(maxsize=2)(self._draw)

    def batch(self, step: int) -> list[int] | list[Clip]:
        """The videos of one step's batch, or clips of one length."""
        if self.short is None:
            return self._videos(step * self.batch_size, self.batch_size)
        if step < self.short["steps"]:
            count, frames = self.short["batch_size"], self.short["frames"]
            first = step * count
            starts = np.random.default_rng([self.seed, step, frames]).integers(self.frames - frames + 1, size=count)
        else:
            count, frames = self.batch_size, self.frames
            first = self.short["steps"] * self.short["batch_size"] + (step - self.short["steps"]) * count
            starts = np.zeros(count, dtype=int)
        videos = self._videos(first, count)
        return [Clip(video, int(start), frames) for video, start in zip(videos, starts, strict=True)]

    def _videos(self, first: int, count: int) -> list[int]:
        return [int(self._order(place // self.size)[place % self.size]) for place in range(first, first + count)]

    def __iter__(self) -> Iterator[list[int] | list[Clip]]:
        for step in range(self.start_step, self.max_steps):
            yield self.batch(step)

    def __len__(self) -> int:
        return max(self.max_steps - self.start_step, 0)

    def _draw(self, epoch: int) -> np.ndarray:
        return np.random.default_rng([self.seed, epoch]).permutation(self.size)
