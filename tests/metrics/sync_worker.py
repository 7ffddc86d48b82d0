"""Scores random videos with the torchmetrics classes: `sync_worker.py RANK WORLD FOLDER BATCHES`, BATCHES in JSON.

Writes what process RANK of WORLD computes, all processes together, to FOLDER/RANK.json.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch
import torch.distributed as dist

from apex_lab.metrics import AdjustedRandIndex, SceneMetrics, SegmentationCovering

VIDEOS, FRAMES, SIDE = 7, 5, 12


def some_videos() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    truth = torch.randint(0, 4, (VIDEOS, FRAMES, SIDE, SIDE), generator=generator)
    noise = torch.randint(0, 6, truth.shape, generator=generator)
    found = torch.where(torch.rand(truth.shape, generator=generator) < 0.6, truth, noise)
    truth[2, 1:3] = 0  # two frames without objects
    return found, truth


def all_metrics() -> dict[str, object]:
    return {
        "scene": SceneMetrics(names=("ari_fg", "msc_fg", "ari", "msc", "sc", "sc_fg")),
        "skip": SceneMetrics(skip_empty=True),
        "ari": AdjustedRandIndex(),
        "video_ari_fg": AdjustedRandIndex(foreground=True, mode="sequence"),
        "msc_fg": SegmentationCovering(background=False, skip_empty=True),
        "sc": SegmentationCovering(scaled=True, mode="frame_then_video"),
    }


def results(metrics: dict[str, object]) -> dict[str, object]:
    found = {}
    for name, metric in metrics.items():
        value = metric.compute()
        found[name] = value if isinstance(value, dict) else float(value)
    found["per_video"] = metrics["scene"].per_video()
    found["size"] = metrics["scene"].size()
    found["left_out"] = metrics["msc_fg"].left_out()
    return found


def run(batches: list[list[int]]) -> dict[str, object]:
    found, truth = some_videos()
    metrics = all_metrics()
    for batch in batches:
        for name, metric in metrics.items():
            if name in ("scene", "skip"):
                metric.update(found[batch], truth[batch], torch.tensor(batch))
            else:
                metric.update(found[batch], truth[batch])
    return results(metrics)


def main(arguments: list[str]) -> None:
    rank, world, folder = int(arguments[0]), int(arguments[1]), Path(arguments[2])
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=world)
    try:
        (folder / f"{rank}.json").write_text(json.dumps(run(json.loads(arguments[3]))))
    finally:
        dist.destroy_process_group()


if __name__ == "__main__":
    main(sys.argv[1:])
