"""Training videos that lie on the device as bytes, so that no step waits for a disk or a copy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from jaxtyping import UInt8
from torch import Tensor
from torch.utils.data import DataLoader

from apex_lab.data.clips import ClipSampler
from apex_lab.data.loading import stop
from apex_lab.data.video_set import Clip, Item, VideoSet


class Resident:
    """Batches of training clips as a loader gives them, but without labels, which training does not read.

    Args:
        videos: all are read once, at the start.
        batches: the clips of each step.
        device: where their frames lie, and the batches.
        options: of the loader that reads them, such as `num_workers`.
    """

    def __init__(self, videos: VideoSet, batches: ClipSampler, device: torch.device, **options: Any) -> None:
        self._videos, self._batches = videos, batches
        whole = [Clip(video, view=view) for video in range(len(videos)) for view in range(videos.views)]
        self._first: dict[tuple[int, int], int] = {}
        at = 0
        for clip in whole:
            self._first[clip.video, clip.view] = at
            at += videos.length(clip.video)
        self._frames = torch.empty(at, 3, *videos.image_size, dtype=torch.uint8, device=device)
        read: DataLoader[Item] = DataLoader(videos, batch_size=None, sampler=whole, **options)
        try:
            for clip, item in zip(whole, read, strict=True):
                first = self._first[clip.video, clip.view]
                self._frames[first : first + videos.length(clip.video)].copy_(item["video"], non_blocking=True)
        finally:
            stop(read)

    def __len__(self) -> int:
        return len(self._batches)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for clips in self._batches:
            yield {
                "video": self._stacked(clips),
                "index": torch.tensor([clip.video for clip in clips]),
                "name": [self._videos.name(clip.video) for clip in clips],
            }

    def _stacked(self, clips: Sequence[Clip]) -> UInt8[Tensor, "B T 3 H W"]:
        """Frames of the clips: slices whose places the host knows, so nothing is copied to the device."""
        parts = []
        for clip in clips:
            first, length = self._first[clip.video, clip.view], self._videos.length(clip.video)
            end = length if clip.frames is None else clip.start + clip.frames
            parts.append(self._frames[first + clip.start : first + end])
        return torch.stack(parts)


def worth_it(videos: VideoSet, batches: ClipSampler, device: torch.device, share: float) -> bool:
    """Whether the videos should lie on a device: on a GPU, where they take at most a share of its free memory.

    Not for a few steps, which would read less than the whole set.
    """
    if device.type != "cuda" or len(batches) * batches.batch_size < len(videos):
        return False
    free, _ = torch.cuda.mem_get_info(device)
    return size(videos) <= share * free


def size(videos: VideoSet) -> int:
    """Bytes of the frames of all videos."""
    height, width = videos.image_size
    return sum(videos.length(video) for video in range(len(videos))) * videos.views * 3 * height * width
