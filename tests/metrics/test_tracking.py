from __future__ import annotations

import math
from typing import Any

import motmetrics
import numpy as np
import pytest
import torch

from apex_lab.metrics.contingency import contingency
from apex_lab.metrics.identity import IdentityCounts
from apex_lab.metrics.tracking import (
    EVENT_TYPES,
    Detections,
    TrackingCounts,
    TrackingSettings,
    clear_events,
    detections,
)

RATES = {
    "MOTA": "mota",
    "MOTP": "motp",
    "Match": "match",
    "IDS": "id_switches",
    "FPs": "fps",
    "Miss": "misses",
    "MD": "md",
    "MT": "mt",
}


def counts_of(prediction: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return contingency(torch.from_numpy(prediction)[None], torch.from_numpy(truth)[None]).counts[0].numpy()


def strip(*frames: list[int]) -> np.ndarray:
    """A video of one-row images; each number stands for eight pixels, more than the small-mask filter drops."""
    return np.repeat(np.array(frames)[:, None, :], 8, axis=2)


def track(prediction: np.ndarray, truth: np.ndarray, **settings: Any) -> TrackingCounts:
    frames = detections(counts_of(prediction, truth), TrackingSettings(**settings))
    return TrackingCounts.of_video(frames, clear_events(frames, settings.get("min_iou", 0.5)))


def identity(prediction: np.ndarray, truth: np.ndarray, **settings: Any) -> IdentityCounts:
    counts = counts_of(prediction, truth)
    return IdentityCounts.of_video(detections(counts, TrackingSettings(**settings)), counts.shape[1:])


def same(value: float, expected: float | None, tolerance: float) -> None:
    if expected is None:
        assert math.isnan(value)
    else:
        assert value == pytest.approx(expected, rel=0, abs=tolerance)


def check(counts: TrackingCounts, idf1: float, expected: dict[str, Any]) -> None:
    rates = counts.rates()
    for theirs, ours in RATES.items():
        same(rates[ours], expected["percent"][theirs], 1e-6)
    same(rates["mota"] / 100, expected["counts"]["mota"], 1e-9)
    same(1 - rates["motp"] / 100, expected["counts"]["motp"], 1e-9)
    same(counts.sum_distance, expected["counts"]["sum_distance"], 1e-9)
    for name in expected["counts"].keys() - {"mota", "motp", "sum_distance"}:
        assert getattr(counts, name) == expected["counts"][name]
    same(idf1, expected["idf1"], 1e-9)


@pytest.mark.parametrize("first_frame", [0, 2])
def test_public_values(public, video: str, first_frame: int) -> None:
    found, truth = public.identities(video), public.truth(video)
    idf1 = identity(found, truth, first_frame=first_frame).idf1()
    check(track(found, truth, first_frame=first_frame), idf1, public.values(video)[f"mot_start{first_frame}"])


@pytest.mark.parametrize("first_frame", [0, 2])
def test_public_values_of_all_videos(public, first_frame: int) -> None:
    pairs = [(public.identities(video), public.truth(video)) for video in public.names]
    counts = TrackingCounts.total(track(*pair, first_frame=first_frame) for pair in pairs)
    idf1 = IdentityCounts.total(identity(*pair, first_frame=first_frame) for pair in pairs).idf1()
    check(counts, idf1, public.expected["aggregate"][f"mot_start{first_frame}"])
    assert TrackingCounts.total(track(*pair, first_frame=first_frame) for pair in reversed(pairs)) == counts


def test_public_events(public, video: str) -> None:
    truth, found = public.truth(video), public.identities(video)
    table = contingency(torch.from_numpy(found)[None], torch.from_numpy(truth)[None])
    events = clear_events(detections(table.counts[0].numpy(), TrackingSettings()))
    label = np.where(events.row < 0, -1, table.labels[0].numpy()[events.row])
    name = np.where(events.column < 0, -1, table.ids[0].numpy()[events.column])
    ours = sorted(zip(events.frame, events.type, label, name, np.nan_to_num(events.distance, nan=-1), strict=True))
    theirs = sorted(map(tuple, np.nan_to_num(public.arrays[f"{video}__events"], nan=-1)))
    np.testing.assert_array_equal([e[:4] for e in ours], [e[:4] for e in theirs])
    np.testing.assert_allclose([e[4] for e in ours], [e[4] for e in theirs], rtol=0, atol=1e-9)


def test_one_accumulator_over_unique_identities_gives_the_same(make) -> None:
    """The protocol's words, followed literally: one accumulator, running frames, identities offset per video."""
    accumulator = motmetrics.MOTAccumulator(auto_id=True)
    parts, offset = [], 0
    for found, truth in make.some_videos(6).values():
        for seed in (None, 3):
            prediction = found if seed is None else make.noisy(found, 0.3, 9, seed)
            frames = detections(counts_of(prediction, truth), TrackingSettings())
            for frame in frames:
                distance = np.where(frame.iou >= 0.5, 1 - frame.iou, np.nan)
                accumulator.update(frame.rows + offset, frame.columns + offset, distance)
            parts.append(TrackingCounts.of_video(frames, clear_events(frames)))
            offset += 1000
    total = TrackingCounts.total(parts)
    names = ["num_frames", "mota", "motp", "num_matches", "num_switches", "num_false_positives", "num_misses"]
    names += ["num_objects", "mostly_tracked", "num_unique_objects"]
    theirs = motmetrics.metrics.create().compute(accumulator, metrics=names).iloc[0]
    rates = total.rates()
    assert rates["mota"] == pytest.approx(100 * theirs["mota"], abs=1e-9)
    assert rates["motp"] == pytest.approx(100 * (1 - theirs["motp"]), abs=1e-9)
    for name in ("num_frames", "num_matches", "num_switches", "num_false_positives", "num_misses", "num_objects"):
        assert getattr(total, name) == theirs[name]
    assert total.num_unique_objects == theirs["num_unique_objects"]
    assert total.num_mostly_detected == theirs["mostly_tracked"]  # their name for what ignores identity
    assert 0 < total.num_switches < total.num_matches


def test_identities_that_repeat_between_videos_cannot_meet() -> None:
    """Metrics.md section 2.3: four videos of three objects, one with flicker."""
    truth = strip(*[[0, 1, 2, 3]] * 4)
    lost = truth.copy()
    lost[1:, :, 8:16][lost[1:, :, 8:16] == 1] = 0
    lost[3] = truth[3]
    predictions = [truth, truth, truth, lost]
    swapped = [p if i % 2 else np.array([0, 2, 3, 1])[p] for i, p in enumerate(predictions)]
    for videos in (predictions, swapped):
        rates = TrackingCounts.total(track(video, truth) for video in videos).rates()
        assert rates["id_switches"] == 0
        assert rates["mota"] == pytest.approx(100 * (1 - 2 / 48))
        assert rates["md"] == rates["mt"] == pytest.approx(100 * 11 / 12)


def test_iou_of_exactly_one_half_is_a_match() -> None:
    truth, found = strip([0, 0, 1, 1]), strip([5, 5, 6, 7])
    rates = track(found, truth).rates()
    assert (rates["match"], rates["fps"], rates["misses"], rates["motp"]) == (100, 100, 0, 50)
    stricter = track(found, truth, min_iou=0.51).rates()
    assert (stricter["match"], stricter["fps"]) == (0, 200)
    assert math.isnan(stricter["motp"])


def test_last_identity_is_kept_however_long_ago() -> None:
    seen, gone = [0, 0, 1], [0, 0, 0]
    truth = strip(seen, gone, gone, seen, seen)
    found = strip([9, 9, 4], [9, 9, 9], [9, 9, 9], [9, 9, 6], [9, 9, 4])
    counts = track(found, truth)
    assert (counts.num_matches, counts.num_switches, counts.num_misses) == (1, 2, 0)
    assert counts.num_mostly_detected == 1
    assert counts.num_mostly_tracked == 0


def test_four_of_five_frames_are_enough() -> None:
    truth = strip(*[[0, 1]] * 5)
    four = strip(*[[7, 8]] * 4, [7, 7])
    assert track(four, truth).rates()["mt"] == 100
    three = strip(*[[7, 8]] * 3, [7, 7], [7, 7])
    assert track(three, truth).rates()["md"] == 0


def test_an_object_that_changes_identity_once_is_tracked_still() -> None:
    truth = strip(*[[0, 1]] * 20)
    found = strip(*[[7, 8]] * 10, *[[7, 9]] * 10)
    rates = track(found, truth).rates()
    assert (rates["mt"], rates["md"], rates["id_switches"]) == (100, 100, 5)


def test_small_masks_are_dropped() -> None:
    truth = np.zeros((1, 1, 40), dtype=np.int64)
    truth[..., :5], truth[..., 10:16] = 1, 2
    found = truth + 10
    counts = track(found, truth)
    assert (counts.num_objects, counts.num_matches, counts.num_false_positives) == (1, 1, 0)
    everything = track(found, truth, min_pixels=0)
    assert (everything.num_objects, everything.num_matches) == (2, 2)


def test_background_is_known_by_its_label() -> None:
    """A frame with next to no background loses neither an object nor its prediction."""
    truth = np.ones((1, 2, 10), dtype=np.int64)
    truth[:, 1] = 2
    assert track(truth, truth).rates()["match"] == 100
    truth[0, 0, :3] = 0
    assert (track(truth, truth).num_objects, track(truth, truth).num_matches) == (2, 2)


def test_background_is_removed_by_overlap() -> None:
    truth = strip([0] * 10 + [1])
    found = strip([5] * 6 + [6] * 2 + [7] * 2 + [1])
    # Shares of the background: 0.6 goes, two of exactly 0.2 stay.
    assert track(found, truth).num_false_positives == 2
    assert track(found, truth, background_iou=0.15).num_false_positives == 0
    assert track(found, truth, background_iou=None).num_false_positives == 3
    # The true background takes part in no match, whatever is removed.
    assert track(found, truth, background_iou=None).num_matches == 1


def test_an_object_segment_over_a_small_background_is_removed() -> None:
    truth = strip([0, 1, 1, 1])
    found = strip([4, 4, 4, 4])
    counts = track(found, truth)
    assert (counts.num_misses, counts.num_false_positives) == (1, 0)


def test_drop_background_slot() -> None:
    truth = strip([0] * 10 + [1])
    counts = counts_of(strip([5] * 8 + [6] * 2 + [1]), truth)
    settings = TrackingSettings(drop_background_slot=True)
    assert detections(counts, settings, [2])[0].columns.tolist() == [0]  # slot 5 by its overlap, slot 6 by name
    assert detections(counts, TrackingSettings(), [2])[0].columns.tolist() == [0, 2]


def test_frames_outside_the_range_do_not_exist() -> None:
    truth = strip([0, 1], [0, 1], [0, 1], [0, 1])
    found = strip([5, 6], [5, 7], [5, 7], [5, 8])
    counts = track(found, truth, first_frame=1, stop_frame=3)
    assert (counts.num_frames, counts.num_objects, counts.num_matches, counts.num_switches) == (2, 2, 2, 0)
    nothing = track(found, truth, first_frame=9)
    assert nothing.num_frames == 0
    assert all(math.isnan(rate) for rate in nothing.rates().values())


def test_undefined_is_nan() -> None:
    truth = np.zeros((2, 4, 8), dtype=np.int64)
    counts = track(truth, truth)
    assert counts.num_frames == 2
    assert all(math.isnan(rate) for rate in counts.rates().values())
    assert math.isnan(identity(truth, truth).idf1())
    only_false = track(strip([5] * 9 + [6]), strip([0] * 10))
    assert only_false.num_false_positives == 1
    assert math.isnan(only_false.rates()["fps"])
    assert TrackingCounts.total([]).rates().keys() == counts.rates().keys()


@pytest.mark.parametrize("seed", range(6))
def test_identities_of_the_rates_on_random_videos(make, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.integers(0, 4, (10, 6, 6)).repeat(4, axis=1).repeat(4, axis=2)
    found = make.noisy(truth, 0.4, 7, seed) if seed % 2 else rng.integers(0, 7, truth.shape)
    counts = track(found, truth)
    rates = counts.rates()
    assert rates["match"] + rates["id_switches"] + rates["misses"] == pytest.approx(100)
    assert rates["mota"] == pytest.approx(rates["match"] - rates["fps"])
    assert rates["md"] >= rates["mt"]
    assert sum((counts.num_matches, counts.num_switches, counts.num_misses)) == counts.num_objects
    renamed = np.array([11, 3, 5, 2**40, 17, 4, 0])[found]
    assert track(renamed, truth) == counts


def test_contradicting_counts_are_a_fault_of_ours() -> None:
    good = track(strip([5, 6]), strip([0, 1]))
    with pytest.raises(AssertionError, match="not 100 percent"):
        TrackingCounts(**{**vars(good), "num_misses": 1}).rates()
    with pytest.raises(AssertionError, match="MD is smaller"):
        TrackingCounts(**{**vars(good), "num_mostly_detected": 0}).rates()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"first_frame": -1}, "first_frame is -1"),
        ({"first_frame": 3, "stop_frame": 3}, "stop_frame 3"),
        ({"min_iou": 0.0}, "min_iou is 0.0"),
        ({"tracked_share": 80.0}, "tracked_share is 80"),
        ({"background_iou": 1.5}, "background_iou is 1.5"),
        ({"min_pixels": -1}, "min_pixels is -1"),
    ],
)
def test_impossible_settings(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TrackingSettings(**settings)


def test_events_have_the_documented_types() -> None:
    frame = Detections(0, np.array([1]), np.array([0, 2]), np.array([[0.7, 0.1]]))
    events = clear_events([frame])
    assert [EVENT_TYPES[i - 1] for i in events.type] == ["MATCH", "FP"]
    assert events.row.tolist() == [1, -1]
    assert events.column.tolist() == [0, 2]
    assert events.distance[0] == pytest.approx(0.3)
