"""Predictions of other programs from the command line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from apex_lab.metrics import KEYS
from tests.conftest import REPOSITORY
from tests.evaluation.conftest import Ask

PUBLIC = REPOSITORY / "tests" / "metrics" / "fixtures" / "metrics_public.npz"


@pytest.fixture
def public(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    shutil.copy(PUBLIC, "public.npz")
    return Path("public.npz")


def change(path: Path, **arrays: np.ndarray) -> None:
    np.savez(path, **{**dict(np.load(path)), **arrays})


def test_every_number_is_written_beside_the_file(public: Path, ask: Ask) -> None:
    ended = ask(f"predictions={public}")
    assert ended.code == 0, ended.err
    result = json.loads(Path("public.metrics.json").read_text())
    assert ended.out.splitlines()[-1] == "public.metrics.json"
    assert set(result["keys"]) == set(result["total"]) == set(KEYS)
    assert (len(result["per_video"]), len(result["per_frame"])) == (8, 64)
    for name, key in KEYS.items():
        for level, rows in (("frame", result["per_frame"]), ("video", result["per_video"])):
            assert all((name in row) == (level in key.levels) for row in rows), (name, level)
    row = [float(number) for number in ended.out.splitlines()[2].split()]
    assert row == [round(result["total"][key], 3) for key in ("ari_fg", "msc_fg", "ari", "msc")]
    assert ended.out.splitlines()[4].split() == ["70.0", "91.4", "80.7", "2.0", "10.7", "17.3", "78.9", "78.9"]
    assert result["by_property"]


def test_output_and_scoring_are_chosen(public: Path, ask: Ask) -> None:
    words = ("output=sub/scores.json", "scoring.tracking.first_frame=2", "scoring.skip_empty=true")
    assert ask(f"predictions={public}", *words).code == 0
    result = json.loads(Path("sub/scores.json").read_text())
    assert result["total"]["mota"] == result["total"]["mota_start2"]
    assert result["settings"]["skip_empty"] is True


def test_truth_of_its_own(public: Path, ask: Ask) -> None:
    arrays = dict(np.load(public))
    np.savez("found.npz", **{key: value for key, value in arrays.items() if not key.endswith("__gt")})
    ended = ask("predictions=found.npz")
    assert ended.code == 1
    assert "__gt is missing" in ended.err
    assert ask("predictions=found.npz", f"truth={public}").code == 0
    assert ask(f"predictions={public}").code == 0
    totals = [json.loads(Path(f"{name}.metrics.json").read_text())["total"] for name in ("found", "public")]
    assert totals[0] == totals[1]


def test_an_ignored_label_and_what_looks_like_one(public: Path, ask: Ask) -> None:
    arrays = dict(np.load(public))
    truth, masks, ids = (arrays[f"perfect__{part}"] for part in ("gt", "masks", "ids"))
    truth = truth.copy()
    truth[:, :12] = 255
    np.savez("void.npz", perfect__gt=truth, perfect__masks=masks, perfect__ids=ids)
    ended = ask("predictions=void.npz")
    assert ended.code == 0
    told = "void.npz: label 255 was scored as an object in 1 videos, first in 'perfect'; where it marks unlabelled"
    assert told in ended.err
    assert "set scoring.ignore_label=255" in ended.err
    assert json.loads(Path("void.metrics.json").read_text())["total"]["msc_fg"] < 1
    ended = ask("predictions=void.npz", "scoring.ignore_label=255")
    assert (ended.code, ended.err) == (0, "")
    result = json.loads(Path("void.metrics.json").read_text())
    assert result["settings"]["ignore_label"] == 255
    assert [result["total"][name] for name in ("ari", "msc_fg", "mota", "hota", "jf")] == [1, 1, 100, 1, 1]


def test_malformed_predictions_are_refused_by_name(public: Path, ask: Ask) -> None:
    masks, ids, gt = (np.load(public)[f"perfect__{part}"] for part in ("masks", "ids", "gt"))
    nan = masks.astype(np.float32)
    nan[1, 0, 2, 3] = np.nan
    twice = ids.copy()
    twice[1] = twice[1, 0]
    for arrays, told in (
        ({"perfect__masks": masks * 0.5}, "the masks sum to 0.5"),
        ({"perfect__masks": nan}, "a mask is nan at (frame, slot, row, column) = (1, 0, 2, 3)"),
        ({"perfect__ids": twice}, "frame 1 has the id"),
        ({"perfect__gt": gt[:, :-1]}, "the masks are 32 x 32, the ground truth 31 x 32"),
        ({"perfect__ids": ids[:-1]}, "T = "),
    ):
        shutil.copy(PUBLIC, public)
        change(public, **arrays)
        ended = ask(f"predictions={public}")
        assert ended.code == 1
        assert "public.npz, video 'perfect'" in ended.err
        assert told in ended.err
        assert not Path("public.metrics.json").exists()


def test_impossible_wishes_are_refused_in_a_sentence(public: Path, ask: Ask) -> None:
    for words, told in {
        ("predictions=none.npz",): "predictions = none.npz does not exist",
        ("export=npz",): "export = 'npz' goes with checkpoint=... alone: leave it out.",
        ("format=mot",): "format = 'mot' is wrong",
        ("output=.",): "output = . is a folder: give the name of a file.",
        ("output=./public.npz",): "output = public.npz would overwrite what is scored",
        ("truth=truth.npz", "output=truth.npz"): "output = truth.npz would overwrite what is scored",
        ("scoring.masks=posterior",): "scoring.masks has no effect on predictions",
        ("scoring.min_presence=0.1",): "scoring.min_presence has no effect on predictions",
        ("scoring.tracking.drop_background_slot=true",): "drop_background_slot has no effect on predictions",
    }.items():
        ended = ask(f"predictions={public}", *words)
        assert ended.code == 2, words
        assert told in ended.err
        assert len(ended.err.splitlines()) == 1


def test_a_place_that_cannot_be_written_is_told_before_any_work(
    public: Path, ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.access", lambda *_: False)
    ended = ask(f"predictions={public}")
    assert ended.code == 2
    assert "choose another file with output=FILE.json" in ended.err
