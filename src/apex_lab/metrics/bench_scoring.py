"""`python -m apex_lab.metrics.bench_scoring`: how long every metric of a test set takes, with the time of each part.

The videos are synthetic: discs that move over a background, and predictions that split, merge, lose and rename them.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import time
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Int64

from apex_lab.metrics.evaluator import Evaluator
from apex_lab.metrics.video_record import EvaluatorSettings


def synthetic_video(
    seed: int, frames: int = 20, side: int = 128, objects: int = 4, segments: int = 8
) -> tuple[Int64[np.ndarray, "T H W"], Int64[np.ndarray, "T H W"]]:
    """A prediction with up to `segments` identities, and the truth with `objects` moving discs."""
    rng = np.random.default_rng(seed)
    time_axis = np.arange(frames)[:, None]
    centre = rng.uniform(0.2, 0.8, (1, objects, 2)) + rng.uniform(-0.01, 0.01, (1, objects, 2)) * time_axis[..., None]
    radius = rng.uniform(0.06, 0.14, objects)
    grid = np.stack(np.meshgrid(*2 * [np.arange(side) / side], indexing="ij"))[:, None, None]
    shift = rng.normal(0, 0.015, (2, frames, objects, 1, 1))

    def discs(at: np.ndarray, size: np.ndarray) -> Int64[np.ndarray, "T H W"]:
        inside = ((grid - at) ** 2).sum(axis=0) < (size**2)[None, :, None, None]
        return np.where(inside.any(axis=1), inside.argmax(axis=1) + 1, 0)

    at = centre.transpose(2, 0, 1)[..., None, None]
    truth, found = discs(at, radius), discs(at + shift, radius * rng.uniform(0.8, 1.1, objects))
    # The last object changes its name half way; the background falls into strips.
    found[frames // 2 :][found[frames // 2 :] == objects] = objects + 1
    strips = max(1, segments - objects - 1)
    strip = objects + 2 + (np.arange(side) * strips) // side
    return np.where(found > 0, found, strip[None, :, None]), truth


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; `arguments` are those of the command line where missing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--videos", type=int, default=200)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--side", type=int, default=128)
    parser.add_argument("--objects", type=int, default=4)
    parser.add_argument("--segments", type=int, default=8)
    parser.add_argument("--per-frame", action="store_true", help="keep rows per frame and events")
    parser.add_argument("--profile", action="store_true", help="show where the time goes")
    options = parser.parse_args(arguments)
    evaluator = Evaluator(EvaluatorSettings(per_frame=options.per_frame, events=options.per_frame))
    profile = cProfile.Profile()
    spent = 0.0
    for video in range(options.videos):
        sizes = (options.frames, options.side, options.objects, options.segments)
        prediction, truth = synthetic_video(video, *sizes)
        start = time.perf_counter()
        if options.profile:
            profile.enable()
        evaluator.add(f"{video:05d}", prediction, truth)
        profile.disable()
        spent += time.perf_counter() - start
    start = time.perf_counter()
    total = evaluator.result()["total"]
    spent += time.perf_counter() - start
    print(
        f"{options.videos} videos x {options.frames} frames x {options.side}^2, {options.objects} objects, "
        f"{options.segments} segments: {spent:.1f} s on {torch.get_num_threads()} threads "
        f"({1e3 * spent / max(1, options.videos):.0f} ms a video)"
    )
    print("  ".join(f"{name} {total[name]:.3f}" for name in ("ari_fg", "msc_fg", "mota", "hota", "jf")))
    if options.profile:
        pstats.Stats(profile).sort_stats("cumulative").print_stats(40)


if __name__ == "__main__":
    main()
