from __future__ import annotations

import importlib.util
import json
import math
import random
import subprocess
import sys
from fractions import Fraction
from pathlib import Path
from types import ModuleType

import pytest
import torch

from apex_lab.metrics import AdjustedRandIndex, SceneMetrics, ari, ari_fg, covering
from apex_lab.metrics.modules import decode_mean, encode_sum

WORKER = Path(__file__).with_name("sync_worker.py")


@pytest.fixture(scope="module")
def worker() -> ModuleType:
    """The module that the processes run."""
    spec = importlib.util.spec_from_file_location("sync_worker", WORKER)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_means_over_frames(worker) -> None:
    found, truth = worker.some_videos()
    value = worker.run([list(range(worker.VIDEOS))])
    assert value["ari"] == pytest.approx(float(ari(found, truth).mean()), abs=1e-14)
    assert value["scene"]["ari_fg"] == pytest.approx(float(ari_fg(found, truth).mean()), abs=1e-14)
    assert value["video_ari_fg"] == pytest.approx(float(ari_fg(found, truth, mode="sequence").mean()), abs=1e-14)
    kept = covering(found, truth, background=False, skip_empty=True)
    assert kept.isnan().sum() == value["left_out"] == value["size"]["empty_frames"] == 2
    assert value["msc_fg"] == value["skip"]["msc_fg"] == pytest.approx(float(kept.nanmean()), abs=1e-14)
    assert value["size"] == {"videos": worker.VIDEOS, "frames": worker.VIDEOS * worker.FRAMES, "empty_frames": 2}
    row = value["per_video"][2]
    assert (row["index"], row["frames"], row["empty_frames"]) == (2, worker.FRAMES, 2)
    assert row["msc"] == pytest.approx(float(covering(found, truth)[2].mean()), abs=1e-14)


def test_order_and_batch_size_change_no_digit(worker) -> None:
    whole = worker.run([list(range(worker.VIDEOS))])
    assert worker.run([[i] for i in range(worker.VIDEOS)]) == whole
    order = list(range(worker.VIDEOS))
    random.Random(0).shuffle(order)
    assert worker.run([order[:2], order[2:3], order[3:]]) == whole


def test_the_last_smaller_batch_has_no_more_weight(worker) -> None:
    found, truth = worker.some_videos()
    metric = AdjustedRandIndex()
    metric.update(found[:6], truth[:6])
    metric.update(found[6:], truth[6:])
    assert float(metric.compute()) == pytest.approx(float(ari(found, truth).mean()), abs=1e-14)


def test_two_processes_give_the_same_numbers(worker, tmp_path: Path) -> None:
    command = [sys.executable, str(WORKER), "1", "2", str(tmp_path), json.dumps([[1], [3, 2]])]
    other = subprocess.Popen(command)
    whole = worker.run([list(range(worker.VIDEOS))])
    worker.main(["0", "2", str(tmp_path), json.dumps([[0, 4, 5], [6]])])
    assert other.wait(timeout=120) == 0
    for rank in range(2):
        assert json.loads((tmp_path / f"{rank}.json").read_text()) == whole


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


def test_reset_and_counted_index(worker) -> None:
    found, truth = worker.some_videos()
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
