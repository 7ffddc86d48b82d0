"""How fast P2D loads: `python -m apex_lab.data.bench_loading DIR`, in frames per second.

Compare with the frames per second that a model consumes in training: loading should be ten times as fast or more.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from torch.utils.data import DataLoader

from apex_lab.base.errors import UserError
from apex_lab.data.clips import ClipSampler
from apex_lab.data.p2d import P2D

FOREVER = 10**9


def frames_per_second(data: P2D, batch_size: int, workers: int, seconds: float) -> float:
    """Frames per second of whole shuffled batches, as training takes them, measured after two batches of warm-up."""
    lengths = [data.length(video) for video in range(len(data))]
    batches = ClipSampler(lengths, batch_size, seed=0, start=0, stop=FOREVER)
    source = iter(DataLoader(data, batch_sampler=batches, num_workers=workers))
    frames = 0
    for _ in range(2 + 2 * workers):  # what the workers have loaded ahead must not count
        next(source)
    began = time.perf_counter()
    while (passed := time.perf_counter() - began) < seconds:
        video = next(source)["video"]
        frames += video.shape[0] * video.shape[1]
    return frames / passed


def main() -> int:
    """Prints one line per number of loading processes."""
    parser = argparse.ArgumentParser(
        prog="python -m apex_lab.data.bench_loading", description="Measures how fast P2D loads."
    )
    parser.add_argument("dir", type=Path, help="folder made by python -m sims.p2d")
    parser.add_argument("--split", default="train")
    parser.add_argument("--batch-size", type=int, default=4)
    parser.add_argument("--workers", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--seconds", type=float, default=5.0)
    options = parser.parse_args()
    try:
        data = P2D(options.dir, options.split)
        if not len(data):
            raise UserError(f"split {options.split} of {options.dir} is empty: choose another")
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    size = data.manifest.settings.image_size
    print(f"{len(data)} videos of {data.clip.stop} frames, {size} x {size}, batches of {options.batch_size}")
    for workers in options.workers:
        speed = frames_per_second(data, options.batch_size, workers, options.seconds)
        print(f"{workers} loading processes: {speed:,.0f} frames per second")
    return 0


if __name__ == "__main__":
    sys.exit(main())
