"""Which clips make which batch: a function of (seed, step) alone, so that a run can resume at any step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Literal

import numpy as np
from torch.utils.data import Sampler

from apex_lab.base.errors import UserError
from apex_lab.data.video_set import Clip

Starts = Literal["random", "disjoint"]
"""Where in their videos clips begin."""

Frames = Callable[[int], int | None]
"""Step -> frames of a clip; None: whole videos."""


def whole_videos(step: int) -> None:
    """Clips are whole videos at every step."""


class ClipSampler(Sampler[list[Clip]]):
    """Batches of clips for the steps from `start` up to `stop`.

    The videos of all epochs form one endless row, each epoch in an order drawn from (seed, epoch); step n takes the
    n-th stretch of `batch_size` of them. So every video is used equally often, no batch is short, and nothing needs
    to be remembered to resume. Where a clip is shorter than its video, its first frame is drawn from (seed, position
    in the row).

    With `disjoint` starts the row consists of clips that cut each video into pieces one after the other; a rest that is
    shorter than a clip is left out. So every piece is used equally often.

    Args:
        lengths: frames of each video.
        batch_size: clips of the global batch.
        seed: of the order and of the first frames.
        start, stop: steps.
        frames: clip length at each step.
        views: cameras per video; one is drawn per clip.
        rank, ranks: each rank takes its share of every batch, in order.
        starts: of clips that are shorter than their videos.

    Raises:
        UserError: the batch cannot be shared equally among the ranks, or clips are longer than videos.
    """

    def __init__(
        self,
        lengths: Sequence[int],
        batch_size: int,
        seed: int,
        start: int,
        stop: int,
        frames: Frames = whole_videos,
        views: int = 1,
        rank: int = 0,
        ranks: int = 1,
        starts: Starts = "random",
    ) -> None:
        if batch_size % ranks:
            raise UserError(f"clips.batch_size = {batch_size} cannot be shared equally among {ranks} processes.")
        self.lengths, self.batch_size, self.seed = lengths, batch_size, seed
        self.start, self.stop, self.frames, self.views = start, stop, frames, views
        each = batch_size // ranks
        self.mine = slice(rank * each, (rank + 1) * each)
        self.starts = starts
        self._order = lru_cache(maxsize=2)(self._draw)
        self._pieces = lru_cache(maxsize=1)(self._cut)
        shortest = min(lengths, default=0)
        for step in range(start, stop) if frames is not whole_videos else ():
            wanted = frames(step)
            if wanted is not None and wanted > shortest:
                raise UserError(
                    f"clips.frames is {wanted} at step {step}, but the shortest training video has "
                    f"{shortest} frames: lower clips.frames or raise data.frames."
                )

    def batch(self, step: int) -> list[Clip]:
        """The clips of one step's global batch."""
        first = step * self.batch_size
        return [self._clip(position, self.frames(step)) for position in range(first, first + self.batch_size)]

    def __iter__(self) -> Iterator[list[Clip]]:
        for step in range(self.start, self.stop):
            yield self.batch(step)[self.mine]

    def __len__(self) -> int:
        return max(self.stop - self.start, 0)

    def _clip(self, position: int, frames: int | None) -> Clip:
        if frames is not None and self.starts == "disjoint":
            return self._piece(position, frames)
        size = len(self.lengths)
        video = int(self._order(position // size, size)[position % size])
        if frames is None and self.views == 1:
            return Clip(video)
        draw = np.random.default_rng([self.seed, position, 1])
        start = 0 if frames is None else int(draw.integers(self.lengths[video] - frames + 1))
        return Clip(video, start, frames, int(draw.integers(self.views)) if self.views > 1 else 0)

    def _piece(self, position: int, frames: int) -> Clip:
        """The clip at a position of the row of disjoint clips."""
        pieces = self._pieces(frames)
        video, start = pieces[int(self._order(position // len(pieces), len(pieces))[position % len(pieces)])]
        draw = np.random.default_rng([self.seed, position, 1])
        return Clip(int(video), int(start), frames, int(draw.integers(self.views)) if self.views > 1 else 0)

    def _cut(self, frames: int) -> np.ndarray:
        """(video, first frame) of all disjoint clips, (N, 2)."""
        starts = [np.arange(length // frames) * frames for length in self.lengths]
        videos = np.repeat(np.arange(len(starts)), [len(each) for each in starts])
        return np.stack([videos, np.concatenate(starts)], axis=1)

    def _draw(self, epoch: int, size: int) -> np.ndarray:
        return np.random.default_rng([self.seed, epoch]).permutation(size)
