"""Which training videos make which batch: a function of (seed, step) alone, so that a run can go on at any step."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from torch.utils.data import Sampler


class TrainBatches(Sampler[list[int]]):
    """Batches for the steps from `start_step` up to `max_steps`.

    The videos of all epochs form one endless row, each epoch in an order drawn from (seed, epoch); step n takes the
    n-th stretch of `batch_size` of them. So every video is used equally often, no batch is short, and nothing needs
    to be remembered to go on.
    """

    def __init__(self, size: int, batch_size: int, seed: int, start_step: int, max_steps: int) -> None:
        self.size, self.batch_size, self.seed = size, batch_size, seed
        self.start_step, self.max_steps = start_step, max_steps
        self._order = lru_cache(maxsize=2)(self._draw)

    def batch(self, step: int) -> list[int]:
        """Indices of the videos of one step's batch."""
        first = step * self.batch_size
        return [
            int(self._order(position // self.size)[position % self.size])
            for position in range(first, first + self.batch_size)
        ]

    def __iter__(self) -> Iterator[list[int]]:
        for step in range(self.start_step, self.max_steps):
            yield self.batch(step)

    def __len__(self) -> int:
        return max(self.max_steps - self.start_step, 0)

    def _draw(self, epoch: int) -> np.ndarray:
        return np.random.default_rng([self.seed, epoch]).permutation(self.size)
