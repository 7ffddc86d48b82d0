from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from apex_lab.base.errors import UserError
from apex_lab.formats import NpzWriter, PredictedVideo, score_predictions, write_result
from apex_lab.formats.npz import one_hot
from apex_lab.metrics import KEYS, EvaluatorSettings, TrackingSettings

FIXTURES = Path(__file__).parents[1] / "metrics" / "fixtures"
PUBLIC = FIXTURES / "metrics_public.npz"


@pytest.fixture(scope="module")
def expected() -> dict[str, Any]:
    return json.loads((FIXTURES / "metrics_public.json").read_text())


def good(frames: int = 3, slots: int = 3) -> dict[str, np.ndarray]:
    """Arrays of a well-formed video `a` with two objects."""
    rng = np.random.default_rng(0)
    masks = rng.random((frames, slots, 8, 8)).astype(np.float32)
    return {
        "a__gt": rng.integers(0, 3, (frames, 8, 8)).astype(np.uint8),
        "a__masks": masks / masks.sum(axis=1, keepdims=True),
        "a__ids": np.tile(np.arange(slots, dtype=np.int32), (frames, 1)),
    }


def save(folder: Path, arrays: dict[str, np.ndarray]) -> Path:
    path = folder / "predictions.npz"
    np.savez(path, **arrays)
    return path


def test_public_file(tmp_path: Path, expected: dict[str, Any]) -> None:
    write_result(score_predictions(PUBLIC), tmp_path / "out" / "metrics.json")
    result = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert set(result["total"]) == set(KEYS) == set(result["keys"])
    assert {len(result["per_video"]), len(result["events"])} == {8}
    assert len(result["per_frame"]) == 64
    assert result["total"]["md"] == pytest.approx(expected["aggregate"]["mot_start0"]["percent"]["MD"])
    for row in result["per_video"]:
        values = expected["videos"][row["video"]]["expected"]
        assert row["sc_fg"] == pytest.approx(values["seg"]["frame_mean"]["sc_fg"], abs=1e-5)
        assert row["video_ari"] == pytest.approx(values["seg"]["sequence"]["ari"], abs=1e-9)
        assert row["motp_start2"] == pytest.approx(values["mot_start2"]["percent"]["MOTP"], abs=1e-6)
        assert row["idf1"] == pytest.approx(values["idf1"] if "idf1" in values else values["mot_start0"]["idf1"])
    empty = next(row for row in result["per_video"] if row["video"] == "empty_prediction")
    assert empty["motp"] is None
    assert result["settings"]["tracking"]["first_frame"] == 0
    assert result["source"]["format"] == "npz"
    assert {row["label"] for row in result["per_object"]} == {1, 2, 3}


def test_one_video_or_many_give_the_same(tmp_path: Path) -> None:
    arrays = dict(np.load(PUBLIC))
    one = save(tmp_path, {key: array for key, array in arrays.items() if key.startswith("soft_ties__")})
    (alone,) = score_predictions(one)["per_video"]
    among = next(row for row in score_predictions(PUBLIC)["per_video"] if row["video"] == "soft_ties")
    assert alone == among


def test_round_trip(tmp_path: Path) -> None:
    arrays = dict(np.load(PUBLIC))
    soft, hard = tmp_path / "soft.npz", tmp_path / "hard.npz"
    with NpzWriter(soft) as keep, NpzWriter(hard) as drop:
        for name in ("id_switch", "occlusion_new_id"):
            gt, masks, ids = (arrays[f"{name}__{part}"] for part in ("gt", "masks", "ids"))
            winner = masks.argmax(axis=1)
            identities = np.take_along_axis(ids[:, :, None, None], winner[:, None], axis=1)[:, 0]
            keep.add(PredictedVideo(name, identities, gt, masks, ids))
            drop.add(PredictedVideo(name, identities, gt))
            np.testing.assert_array_equal(np.load(PUBLIC)[f"{name}__masks"], masks)
    for name in ("id_switch", "occlusion_new_id"):
        np.testing.assert_array_equal(np.load(soft)[f"{name}__masks"], arrays[f"{name}__masks"])
    assert not list(tmp_path.glob(".*"))
    first, second = score_predictions(soft), score_predictions(hard)
    assert first["total"] == second["total"]


def test_an_interrupted_file_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="stop"), NpzWriter(tmp_path / "a.npz"):
        raise RuntimeError("stop")
    assert list(tmp_path.iterdir()) == []


def test_one_hot_masks_say_the_same() -> None:
    identities = np.array([[[4, 4, 9]], [[4, 4, 4]]])
    masks, ids = one_hot(identities)
    assert ids.tolist() == [[4, 9], [4, -1]]
    assert masks[:, 1].tolist() == [[[0, 0, 1]], [[0, 0, 0]]]


def test_whole_numbers_and_half_precision_are_masks(tmp_path: Path) -> None:
    arrays = good()
    winner = arrays["a__masks"].argmax(axis=1)
    expected = score_predictions(save(tmp_path, arrays))["total"]
    one_hot_masks = winner[:, None] == np.arange(3)[:, None, None]
    for dtype in (np.uint8, bool, np.float16, np.float64, ">f4"):
        found = score_predictions(save(tmp_path, arrays | {"a__masks": one_hot_masks.astype(dtype)}))["total"]
        assert found["msc"] == expected["msc"]
    half = score_predictions(save(tmp_path, arrays | {"a__masks": arrays["a__masks"].astype(np.float16)}))
    assert half["total"]["msc"] == pytest.approx(expected["msc"], abs=0.1)


def test_masks_of_another_size(tmp_path: Path) -> None:
    arrays = dict(np.load(PUBLIC))
    gt = arrays["perfect__gt"]
    big = {
        "a__gt": gt.repeat(2, axis=1).repeat(2, axis=2),
        "a__masks": arrays["perfect__masks"],
        "a__ids": arrays["perfect__ids"],
    }
    path = save(tmp_path, big)
    with pytest.raises(UserError, match=r"the masks are 32 x 32, the ground truth 64 x 64; set resize"):
        score_predictions(path)
    assert score_predictions(path, resize="truth")["total"]["msc"] == 1
    assert score_predictions(path, resize="masks")["total"]["msc"] == 1  # one-hot masks grow by whole pixels
    path = save(tmp_path, big | {"a__gt": gt[:, ::2, ::2]})
    assert score_predictions(path, resize="truth")["total"]["msc"] > 0.8
    assert score_predictions(path, resize="masks")["total"]["msc"] > 0.8
    with pytest.raises(UserError, match="resize is 'both'"):
        score_predictions(path, resize="both")


def test_ground_truth_from_another_file(tmp_path: Path) -> None:
    arrays = good()
    truth = tmp_path / "truth.npz"
    np.savez(truth, a__gt=arrays["a__gt"])
    path = save(tmp_path, {key: array for key, array in arrays.items() if key != "a__gt"})
    assert score_predictions(path, truth=truth)["total"] == score_predictions(save(tmp_path, arrays))["total"]
    np.savez(truth, a__gt=arrays["a__gt"], b__gt=arrays["a__gt"])
    with pytest.raises(UserError, match="1 of the 2 videos of the ground truth have no prediction, the first is 'b'"):
        score_predictions(path, truth=truth)
    assert score_predictions(path, truth=truth, partial=True)["total"]["videos"] == 1
    np.savez(truth, b__gt=arrays["a__gt"])
    with pytest.raises(UserError, match="video 'a' has no ground truth"):
        score_predictions(path, truth=truth)
    np.savez(truth, a__gt=arrays["a__gt"][:2])
    with pytest.raises(UserError, match="the prediction has 3 frames, the ground truth 2"):
        score_predictions(path, truth=truth)


def change(name: str, place: tuple[Any, ...], value: float) -> dict[str, np.ndarray]:
    array = good()[name].copy()
    if array.dtype == np.uint8:
        array = array.astype(np.int16)
    array[place] = value
    return {name: array}


MALFORMED: dict[str, tuple[dict[str, Any], str]] = {
    "sum": (
        change("a__masks", (1, 0, 2, 3), 0.9),
        r"video 'a': the masks sum to .* \(frame, row, column\) = \(1, 2, 3\)",
    ),
    "scaled": ({"a__masks": good()["a__masks"] * 0.99}, "the masks sum to 0.99"),
    "nan": (
        change("a__masks", (2, 1, 0, 0), np.nan),
        r"a mask is nan at \(frame, slot, row, column\) = \(2, 1, 0, 0\)",
    ),
    "infinite": (change("a__masks", (2, 1, 0, 0), np.inf), "a mask is inf"),
    "negative": ({"a__masks": good()["a__masks"] + np.array([-1, 1, 0], dtype=np.float32)[:, None, None]}, "negative"),
    "duplicate": (change("a__ids", (1, 0), 2), "frame 1 has the id 2 more than once"),
    "absent": (
        change("a__ids", (1, 0), -1),
        r"id -1 \(absent\) wins the pixel .* an absent slot must have a zero mask",
    ),
    "id": (change("a__ids", (1, 0), -2), "an id is -2"),
    "ignore": (change("a__gt", (0, 1, 1), -1), r"the ground truth is -1 at \(frame, row, column\) = \(0, 1, 1\)"),
    "frames": ({"a__ids": good(2)["a__ids"]}, "ids has T = 2, gt has T = 3"),
    "truth frames": ({"a__gt": good(4)["a__gt"]}, "has T = 4"),
    "slots": ({"a__ids": good(slots=4)["a__ids"]}, "ids has K = 4, masks has K = 3"),
    "size": ({"a__gt": good()["a__gt"][:, :4]}, "the masks are 8 x 8, the ground truth 4 x 8"),
    "dimensions": ({"a__masks": good()["a__masks"][0]}, r"masks has the shape \(3, 8, 8\); want \(T, K, H, W\)"),
    "no frame": ({name: array[:0] for name, array in good().items()}, "none of it 0"),
    "missing": ({"a__ids": None}, "the array a__ids is missing"),
    "no truth": ({"a__gt": None}, "the array a__gt is missing"),
    "nothing": ({"a__ids": None, "a__gt": None, "a__masks": None, "b": np.zeros(3)}, "holds no video"),
    "text": ({"a__masks": good()["a__masks"].astype("U4")}, "masks has the type <U4; want real numbers"),
    "complex": ({"a__masks": good()["a__masks"].astype(complex)}, "masks has the type complex128"),
    "objects": ({"a__masks": good()["a__masks"].astype(object)}, "masks has the type object"),
    "float ids": ({"a__ids": good()["a__ids"].astype(float)}, "ids has the type float64; want integers"),
    "float truth": ({"a__gt": good()["a__gt"].astype(float)}, "gt has the type float64; want integers"),
    "huge id": ({"a__ids": good()["a__ids"].astype(np.int64) + 2**60}, "ids end at 2"),
    "huge label": ({"a__gt": good()["a__gt"].astype(np.uint64) + np.uint64(2**63)}, "labels end at 2"),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_malformed_predictions_are_refused_by_name(tmp_path: Path, case: str) -> None:
    changes, message = MALFORMED[case]
    arrays = {key: array for key, array in (good() | changes).items() if array is not None}
    with pytest.raises(UserError, match=message) as caught:
        score_predictions(save(tmp_path, arrays))
    assert "predictions.npz" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_absent_slot_that_wins_nothing_is_fine(tmp_path: Path) -> None:
    arrays = good()
    arrays["a__masks"][1, 1] += arrays["a__masks"][1, 0]
    arrays["a__masks"][1, 0] = 0
    arrays["a__ids"][1, 0] = -1
    assert score_predictions(save(tmp_path, arrays))["total"]["frames"] == 3


def test_files_that_are_no_npz(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with pytest.raises(UserError, match=r"there is no file or folder .*a\.npz"):
        score_predictions(path)
    path.write_bytes(b"")
    with pytest.raises(UserError, match="no readable npz file"):
        score_predictions(path)
    path.write_bytes(b"not a zip at all")
    with pytest.raises(UserError, match="no readable npz file"):
        score_predictions(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a__gt.npy", b"not an array")
    with pytest.raises(UserError, match="no readable npz file"):
        score_predictions(path)
    (tmp_path / "a.tar").write_bytes(b"")
    with pytest.raises(UserError, match=r"is neither \.npz nor \.json"):
        score_predictions(tmp_path / "a.tar")
    with pytest.raises(UserError, match="format is 'zip'"):
        score_predictions(path, format="zip")


def test_cut_off_and_damaged_files(tmp_path: Path) -> None:
    path = save(tmp_path, good())
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match="no readable npz file"):
        score_predictions(path)
    spoilt = bytearray(whole)
    spoilt[whole.index(good()["a__masks"].tobytes()) + 64] ^= 255
    path.write_bytes(spoilt)
    with pytest.raises(UserError, match=r"a__masks.*(damaged|Bad CRC)|Bad CRC.*a__masks"):
        score_predictions(path)


def test_settings_reach_the_numbers(tmp_path: Path) -> None:
    strict = EvaluatorSettings(tracking=TrackingSettings(min_iou=0.9, first_frame=1))
    total = score_predictions(PUBLIC, settings=strict)["total"]
    assert total["num_frames"] == 56
    assert total["mota"] < 70
    dropping = EvaluatorSettings(tracking=TrackingSettings(drop_background_slot=True))
    with pytest.raises(UserError, match=r"metrics_public\.npz: drop_background_slot is set"):
        score_predictions(PUBLIC, settings=dropping)
