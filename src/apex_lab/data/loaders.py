"""Loaders: training clips step by step, and whole videos in order."""

from __future__ import annotations

import torch
from torch.utils.data import DataLoader, Subset

from apex_lab.data.clips import ClipSampler, Frames, Starts, whole_videos
from apex_lab.data.loading import options
from apex_lab.data.resident import Resident, worth_it
from apex_lab.data.source import VideoSource
from apex_lab.data.video_set import Item, VideoSet

Loader = DataLoader[Item]


def training_loader(
    source: VideoSource,
    batch_size: int,
    seed: int,
    start: int,
    stop: int,
    frames: Frames = whole_videos,
    rank: int = 0,
    ranks: int = 1,
    starts: Starts = "random",
    device: torch.device | None = None,
    share: float = 0.0,
) -> Loader | Resident:
    """One batch of training clips for each step from `start` up to `stop`.

    Args:
        source: opened.
        batch_size, seed, start, stop, frames, rank, ranks, starts: as in `ClipSampler`.
        device: that trains; None: batches lie on the host.
        share: of the device's free memory that the videos may take; see `apex_lab.data.resident.worth_it`.
    """
    videos = source.sets["train"]
    lengths = [videos.length(i) for i in range(len(videos))]
    batches = ClipSampler(lengths, batch_size, seed, start, stop, frames, videos.views, rank, ranks, starts)
    if device is not None and worth_it(videos, batches, device, share):
        return Resident(videos, batches, device, **options(source.workers))
    return DataLoader(videos, batch_sampler=batches, **options(source.workers))


def whole_loader(
    videos: VideoSet, batch_size: int, count: int | None = None, workers: int = 0, rank: int = 0, ranks: int = 1
) -> Loader:
    """The first `count` whole videos of a set (None: all) in order.

    Args:
        videos: the set.
        batch_size: videos at a time; videos of different lengths come one at a time.
        count: how many.
        workers: processes that load.
        rank, ranks: each rank gets every `ranks`-th video.
    """
    total = len(videos) if count is None else min(count, len(videos))
    chosen = range(rank, total, ranks)
    equal = len({videos.length(i) for i in chosen}) <= 1
    return DataLoader(Subset(videos, chosen), batch_size=batch_size if equal else 1, **options(workers))
