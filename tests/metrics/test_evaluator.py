from __future__ import annotations

import math
import pickle
from typing import Any

import numpy as np
import pytest
from pandas.testing import assert_frame_equal

from apex_lab.metrics import KEYS, Evaluator, EvaluatorSettings, TrackingSettings
from apex_lab.metrics import bench_scoring as bench
from apex_lab.metrics.keys import FRAME_SCORES, VIDEO_SCORES, keys
from apex_lab.metrics.tracking import EVENT_TYPES

EVERYTHING = EvaluatorSettings(per_frame=True, events=True)


def evaluate(videos: dict[str, tuple[np.ndarray, np.ndarray]], settings: EvaluatorSettings | None = None) -> Evaluator:
    evaluator = Evaluator(settings)
    for name, (prediction, truth) in videos.items():
        evaluator.add(name, prediction, truth)
    return evaluator


def assert_same(one: Any, other: Any) -> None:
    """Equal to the last digit, NaN equal to itself."""
    assert_frame_equal(one.pop("per_object"), other.pop("per_object"), check_exact=True)
    assert pickle.dumps(one) == pickle.dumps(other) or repr(one) == repr(other)


@pytest.fixture
def videos(make) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    found = make.some_videos(6)
    nothing = np.zeros_like(found["v0"][1])
    return found | {"no_object": (found["v0"][0], nothing), "no_segment": (nothing, found["v1"][1])}


def test_public_values(public) -> None:
    videos = {name: (public.identities(name), public.truth(name)) for name in public.names}
    result = evaluate(videos, EVERYTHING).result()
    expected = public.expected["aggregate"]
    for block, prefix in (("seg_all_frames_mean", ""), ("seg_sequence_mean", "video_")):
        for name, value in expected[block].items():
            tolerance = 1e-9 if name.startswith("ari") else 1e-5
            assert result["total"][prefix + name] == pytest.approx(value, rel=0, abs=tolerance)
    for suffix, block in (("", "mot_start0"), ("_start2", "mot_start2")):
        assert result["total"]["mota" + suffix] == pytest.approx(expected[block]["percent"]["MOTA"], abs=1e-6)
        assert result["total"]["idf1" + suffix] == pytest.approx(expected[block]["idf1"], abs=1e-9)
        assert result["total"]["num_switches" + suffix] == expected[block]["counts"]["num_switches"]
    assert result["total"]["hota"] == pytest.approx(expected["hota_combined"]["HOTA"], abs=1e-9)
    for row in result["per_video"]:
        values = public.values(row["video"])
        assert row["msc_fg"] == pytest.approx(values["seg"]["frame_mean"]["msc_fg"], abs=1e-5)
        assert row["num_matches"] == values["mot_start0"]["counts"]["num_matches"]
        curve = result["hota_alpha"]["per_video"][row["video"]]
        np.testing.assert_allclose(curve, public.arrays[f"{row['video']}__hota_alpha"], rtol=0, atol=1e-9)
        events = result["events"][row["video"]]
        theirs = public.arrays[f"{row['video']}__events"]
        types = [EVENT_TYPES[int(kind) - 1] for kind in sorted(theirs[:, 1])]
        assert sorted(event["type"] for event in events) == sorted(types)
    for row in result["per_frame"]:
        value = public.values(row["video"])["seg"]["per_frame"]["ari_fg"][row["frame"]]
        assert row["ari_fg"] == pytest.approx(value, abs=1e-9)


def test_every_key_is_documented(videos) -> None:
    result = evaluate(videos, EVERYTHING).result()
    assert list(result["total"]) == list(KEYS)
    assert list(result["per_video"][0]) == ["video", *(name for name, key in KEYS.items() if "video" in key.levels)]
    per_frame = ["video", "frame", *(name for name, key in KEYS.items() if "frame" in key.levels)]
    assert list(result["per_frame"][0]) == per_frame
    assert all(key.better in ("up", "down", None) and key.meaning.endswith(".") for key in KEYS.values())
    for first in (None, 4):
        total = evaluate({}, EvaluatorSettings(public_first_frame=first)).result()["total"]
        assert list(total) == list(keys(first))


def test_order_and_merging_change_no_digit(videos) -> None:
    whole = evaluate(videos, EVERYTHING)
    names = list(videos)
    backwards = evaluate({name: videos[name] for name in reversed(names)}, EVERYTHING)
    parts = [evaluate({name: videos[name] for name in names[i::2]}, EVERYTHING) for i in (1, 0)]
    merged = pickle.loads(pickle.dumps(parts[0]))
    merged.merge(pickle.loads(pickle.dumps(parts[1])))
    expected = whole.result()
    assert_same(backwards.result(), dict(expected))
    assert_same(merged.result(), dict(expected))


def test_totals_are_sums_of_videos(videos) -> None:
    result = evaluate(videos).result()
    for name in (name for name in KEYS if name.startswith("num_") or name in ("frames", "empty_frames")):
        assert result["total"][name] == sum(row[name] for row in result["per_video"])


def test_oracle(make) -> None:
    videos = {name: (truth + 5, truth) for name, (_, truth) in make.some_videos(5).items()}
    total = evaluate(videos).result()["total"]
    ones = [name for name, key in KEYS.items() if key.better == "up" and key.range in ("0 to 1", KEYS["ari"].range)]
    assert len(ones) > 20
    assert {name: total[name] for name in ones} == dict.fromkeys(ones, 1.0)
    for suffix in ("", "_start2"):
        hundreds = {total[name + suffix] for name in ("mota", "motp", "match", "md", "mt")}
        assert hundreds == {100.0}
        assert {total[name + suffix] for name in ("id_switches", "fps", "misses", "sum_distance")} == {0.0}


@pytest.mark.parametrize("objects", [1, 2, 3, 4])
def test_one_segment(objects: int) -> None:
    truth = np.random.default_rng(objects).integers(0, objects + 1, (3, 12, 12)).repeat(4, axis=1)
    total = evaluate({"a": (np.full_like(truth, 3), truth)}).result()["total"]
    assert total["msc"] == pytest.approx(1 / (objects + 1), abs=1e-15)
    assert total["ari"] == 0
    assert total["ari_fg"] == float(objects == 1)
    assert total["match"] == 0
    assert total["misses"] == 100


def test_names_of_identities_do_not_matter(videos) -> None:
    renamed = np.array([17, 3, 2**50, 5, 0, 8, 1, 40, 2, 99, 6])
    videos = {name: pair for name, pair in videos.items() if len(np.unique(pair[0])) > 1}
    other = {name: (renamed[prediction], truth) for name, (prediction, truth) in videos.items()}
    one, two = evaluate(videos).result()["total"], evaluate(other).result()["total"]
    assert one == pytest.approx(two, abs=1e-12)


def test_models_without_identities(make) -> None:
    found = {name: (p + 100 * np.arange(len(p))[:, None, None], t) for name, (p, t) in make.some_videos(3).items()}
    own, none = evaluate(found).result(), evaluate(found, EvaluatorSettings(identities="none", per_frame=True)).result()
    for name in ("ari", "ari_fg", "msc", "msc_fg", "sc", "mbo", "miou"):
        assert none["total"][name] == own["total"][name]
    for name in ("video_ari", "jf", "hota", "mota", "idf1", "md_start2"):
        assert math.isnan(none["total"][name])
    assert none["per_object"][["video_iou", "j", "detected"]].isna().all(axis=None)
    assert math.isnan(none["per_frame"][0]["mota"])
    linked = evaluate(found, EvaluatorSettings(identities="linked")).result()["total"]
    assert linked["mota"] > own["total"]["mota"]
    assert linked["ari_fg"] == own["total"]["ari_fg"]
    assert linked["id_switches"] < 5


def test_skip_empty(videos) -> None:
    plain, skipping = (evaluate(videos, EvaluatorSettings(skip_empty=skip)).result()["total"] for skip in (False, True))
    share = plain["empty_frames"] / plain["frames"]
    assert 0 < share < 1
    assert plain["msc_fg"] == pytest.approx(skipping["msc_fg"] * (1 - share))
    assert plain["ari_fg"] == pytest.approx(skipping["ari_fg"] * (1 - share) + share)
    assert plain["msc"] == skipping["msc"]


@pytest.mark.parametrize("identities", ["own", "none", "linked"])
def test_segmentation_from_a_frame_on_is_that_of_the_rest_of_the_video(make, identities: str) -> None:
    videos = make.some_videos(3)
    later = EvaluatorSettings(first_frame=3, identities=identities, per_frame=True)
    found = evaluate(videos, later).result()
    whole = evaluate(videos, EvaluatorSettings(identities=identities, per_frame=True)).result()
    rest = {name: (prediction[3:], truth[3:]) for name, (prediction, truth) in videos.items()}
    cut = evaluate(rest, EvaluatorSettings(identities=identities, per_frame=True)).result()
    segmentation = [*FRAME_SCORES, *VIDEO_SCORES, "j", "f", "jf"]
    for name, value in found["total"].items():
        # identities that are linked from the first frame on may differ from those linked later, not their overlaps
        expected = cut if name in segmentation and (identities != "linked" or name in FRAME_SCORES) else whole
        if identities != "linked" or name not in (*VIDEO_SCORES, "j", "f", "jf"):
            assert value == pytest.approx(expected["total"][name], nan_ok=True), name
    rows = [row for row in found["per_frame"] if row["frame"] >= 3]
    assert [row["ari"] for row in rows] == [row["ari"] for row in cut["per_frame"]]
    assert all(math.isnan(row["ari"]) for row in found["per_frame"] if row["frame"] < 3)


def test_a_video_that_ends_before_the_first_frame_has_no_segmentation(make) -> None:
    total = evaluate(make.some_videos(2), EvaluatorSettings(first_frame=99)).result()["total"]
    assert all(math.isnan(total[name]) for name in ("ari", "video_ari", "j", "f"))
    assert total["num_frames"] > 0
    with pytest.raises(ValueError, match="first_frame is -1; frames are counted from 0"):
        EvaluatorSettings(first_frame=-1)


def test_settings_are_stored(make) -> None:
    settings = EvaluatorSettings(tracking=TrackingSettings(min_iou=0.6, stop_frame=5), public_first_frame=3)
    result = evaluate(make.some_videos(1), settings).result()
    assert result["settings"]["tracking"]["min_iou"] == 0.6
    assert result["total"]["num_frames"] == 5
    assert result["total"]["num_frames_start3"] == 2
    assert {"python", "torch", "motmetrics"} <= result["versions"].keys()


def test_nothing_at_all() -> None:
    result = Evaluator().result()
    assert result["total"]["videos"] == 0
    assert math.isnan(result["total"]["ari"])
    assert result["per_video"] == []


def test_records_do_not_grow_with_the_image(make) -> None:
    small, large = (len(pickle.dumps(evaluate(make.some_videos(2, side=side)))) for side in (32, 96))
    assert large < 1.2 * small


def test_refusals(make) -> None:
    prediction, truth = make.strip([1, 2]), make.strip([0, 3])
    evaluator = evaluate({"a": (prediction, truth)})
    with pytest.raises(ValueError, match="video 'a' was scored before"):
        evaluator.add("a", prediction, truth)
    with pytest.raises(ValueError, match="identities end at 2"):
        evaluator.add("b", prediction + 2**60, truth)
    with pytest.raises(ValueError, match="video 'a' was scored by both"):
        evaluator.merge(evaluate({"a": (prediction, truth)}))
    with pytest.raises(ValueError, match="different settings"):
        evaluator.merge(Evaluator(EVERYTHING))
    with pytest.raises((ValueError, TypeError), match="identities"):
        EvaluatorSettings(identities="other")
    with pytest.raises(ValueError, match="boundary_tolerance is 3"):
        EvaluatorSettings(boundary_tolerance=3.0)
    dropping = Evaluator(EvaluatorSettings(tracking=TrackingSettings(drop_background_slot=True)))
    with pytest.raises(ValueError, match="which identities of video 'a' are background"):
        dropping.add("a", prediction, truth)
    dropping.add("a", prediction, truth, background_ids=[1])
    assert dropping.result()["total"]["num_matches"] == 1


def test_benchmark_runs(capsys: pytest.CaptureFixture[str]) -> None:
    bench.main(["--videos", "2", "--frames", "3", "--side", "32", "--profile"])
    answer = capsys.readouterr().out
    assert "2 videos x 3 frames x 32^2" in answer
    assert "score_video" in answer
