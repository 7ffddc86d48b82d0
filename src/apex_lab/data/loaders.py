"""Loaders: training clips step by step, and whole videos in order."""

from __future__ import annotations

import os
import signal
from typing import Any

import torch
from torch.utils.data import DataLoader, Subset

from apex_lab.data.clips import ClipSampler, Frames, Starts, whole_videos
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
        return Resident(videos, batches, device, **{**_options(source.workers), "persistent_workers": False})
    return DataLoader(videos, batch_sampler=batches, **_options(source.workers))


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
    return DataLoader(Subset(videos, chosen), batch_size=batch_size if equal else 1, **_options(workers))


def _options(workers: int) -> dict[str, Any]:
    return {
        "num_workers": workers,
        "persistent_workers": workers > 0,
        "worker_init_fn": _outlive_one_request if workers else None,
        "pin_memory": torch.cuda.is_available(),
        # a generator of its own: starting a loader must not change the random numbers of the training
        "generator": torch.Generator().manual_seed(0),
    }


GRACE = 60
"""Seconds that a loading process lives on after its first SIGTERM."""


def _outlive_one_request(worker: int) -> None:
    """In a loading process: the parent decides when to stop, also where a signal goes to all processes of a job.

    A loader that died of it at once would take the step at hand with it. Its second SIGTERM (PyTorch sends one at the
    end to a loader that hangs) or the end of the grace ends it.
    """

    def first(signum: int, frame: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        if os.name == "posix":
            signal.alarm(GRACE)

    for name in ("SIGINT", "SIGUSR1", "SIGUSR2", "SIGXCPU"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    signal.signal(signal.SIGTERM, first)
