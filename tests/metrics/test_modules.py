from __future__ import annotations

import math
import random
from fractions import Fraction
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp

from apex_lab.metrics import AdjustedRandIndex, SceneMetrics, SegmentationCovering, ari, ari_fg, covering
from apex_lab.metrics.modules import decode_mean, encode_sum

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


def test_means_over_frames() -> None:
    found, truth = some_videos()
    value = run([list(range(VIDEOS))])
    assert value["ari"] == pytest.approx(float(ari(found, truth).mean()), abs=1e-14)
    assert value["scene"]["ari_fg"] == pytest.approx(float(ari_fg(found, truth).mean()), abs=1e-14)
    assert value["video_ari_fg"] == pytest.approx(float(ari_fg(found, truth, mode="sequence").mean()), abs=1e-14)
    kept = covering(found, truth, background=False, skip_empty=True)
    assert kept.isnan().sum() == value["left_out"] == value["size"]["empty_frames"] == 2
    assert value["msc_fg"] == value["skip"]["msc_fg"] == pytest.approx(float(kept.nanmean()), abs=1e-14)
    assert value["size"] == {"videos": VIDEOS, "frames": VIDEOS * FRAMES, "empty_frames": 2}
    row = value["per_video"][2]
    assert (row["index"], row["frames"], row["empty_frames"]) == (2, FRAMES, 2)
    assert row["msc"] == pytest.approx(float(covering(found, truth)[2].mean()), abs=1e-14)


def test_order_and_batch_size_change_no_digit() -> None:
    whole = run([list(range(VIDEOS))])
    assert run([[i] for i in range(VIDEOS)]) == whole
    order = list(range(VIDEOS))
    random.Random(0).shuffle(order)
    assert run([order[:2], order[2:3], order[3:]]) == whole


def test_the_last_smaller_batch_has_no_more_weight() -> None:
    found, truth = some_videos()
    metric = AdjustedRandIndex()
    metric.update(found[:6], truth[:6])
    metric.update(found[6:], truth[6:])
    assert float(metric.compute()) == pytest.approx(float(ari(found, truth).mean()), abs=1e-14)


def _worker(rank: int, folder: str) -> None:
    dist.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=2)
    mine = [[0, 4, 5], [6]] if rank == 0 else [[1], [3, 2]]
    torch.save(run(mine), f"{folder}/{rank}.pt")
    dist.destroy_process_group()


def test_two_processes_give_the_same_numbers(tmp_path: Path) -> None:
    mp.start_processes(_worker, args=(str(tmp_path),), nprocs=2, start_method="spawn")
    whole = run([list(range(VIDEOS))])
    for rank in range(2):
        assert torch.load(tmp_path / f"{rank}.pt") == whole


def test_sums_are_exact() -> None:
    generator = torch.Generator().manual_seed(1)
    values = torch.rand(10_000, dtype=torch.float64, generator=generator) * 1.5 - 0.5
    exact = sum((Fraction(v) for v in values.tolist()), Fraction(0)) / len(values)
    assert decode_mean(encode_sum(values), len(values)) == pytest.approx(float(exact), rel=0, abs=1e-16)
    many = encode_sum(torch.ones(5000, dtype=torch.float64)) * 400_000  # two billion ones
    assert decode_mean(many, 5000 * 400_000) == 1.0
    assert decode_mean(encode_sum(-torch.full((3,), 0.25, dtype=torch.float64)), 3) == -0.25


def test_before_the_first_update() -> None:
    metric = SceneMetrics()
    with pytest.warns(UserWarning, match="before the ``update`` method"):
        assert all(math.isnan(value) for value in metric.compute().values())
    assert metric.per_video() == []
    assert metric.size() == {"videos": 0, "frames": 0, "empty_frames": 0}


def test_reset_and_counted_index() -> None:
    found, truth = some_videos()
    metric = SceneMetrics()
    metric.update(found, truth)
    metric.reset()
    metric.update(found[:2], truth[:2])
    metric.update(found[2:5], truth[2:5])
    assert [row["index"] for row in metric.per_video()] == [0, 1, 2, 3, 4]
    assert metric.size()["videos"] == 5


def test_unknown_name() -> None:
    with pytest.raises(ValueError, match="no segmentation score 'iou'"):
        SceneMetrics(names=("iou",))
