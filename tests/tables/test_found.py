"""Run folders as they are found: states, failed seeds, damage."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from apex_lab.base.errors import UserError
from apex_lab.tables.found import SeedRun, read_arrangement, read_run
from apex_lab.training.learner import Diverged, Learner
from apex_lab.training.update import WeightUpdate
from tests.tables.folders import run_folder
from tests.tiny import Layers


def only(outputs: Path) -> SeedRun:
    (folder,) = outputs.glob("*/seed_*")
    run = read_run(folder, int(folder.name.removeprefix("seed_")))
    assert run is not None
    return run


def test_a_finished_run(tmp_path: Path) -> None:
    folder = run_folder(tmp_path, "apex", 3, {"ari_fg": 0.25, "motp": None, "notes": "words"})
    run = only(tmp_path)
    assert (run.folder, run.seed, run.state) == (folder, 3, "finished")
    assert run.scores["ari_fg"] == 0.25
    assert math.isnan(run.scores["motp"])
    assert "notes" not in run.scores
    assert run.protocol is not None
    assert (run.protocol.videos, run.protocol.frames) == (200, 4000)
    assert run.failure is None


def test_a_run_that_was_never_started(tmp_path: Path) -> None:
    assert read_run(tmp_path / "seed_0", 0) is None


def test_a_run_whose_outcome_is_diverged_makes_a_failed_seed(tmp_path: Path) -> None:
    run_folder(tmp_path, "gswm", 0, status="failed", outcome="diverged", reason="In other words.")
    run = only(tmp_path)
    assert (run.state, run.failure) == ("diverged", "its loss was not finite")


def test_a_run_of_today_is_judged_by_its_outcome_alone(tmp_path: Path) -> None:
    reason = "train/loss is nan at step 7 (not finite: train/loss): try a lower optimizer.lr."
    run_folder(tmp_path, "gswm", 0, status="failed", outcome="failed", reason=reason)
    run = only(tmp_path)
    assert (run.state, run.failure) == ("unfinished", None)


def test_what_the_learner_says_of_a_loss_that_is_not_finite_makes_a_failed_seed_of_a_run_without_outcome(
    tmp_path: Path,
) -> None:
    """Runs of format 1 record their end as a sentence, which is still that of today."""
    learner = Learner(WeightUpdate(Layers(), {}, {}, step=7), lambda named: torch.optim.SGD([w for _, w in named]))
    learner.update.latest = {"train/loss": torch.tensor(float("nan"))}
    with pytest.raises(Diverged) as error:
        learner.fetch()
    run_folder(tmp_path, "gswm", 0, status="failed", reason=str(error.value))
    run = only(tmp_path)
    assert (run.state, run.failure) == ("diverged", "its loss was not finite")


def test_other_ends_are_no_failed_seeds(tmp_path: Path) -> None:
    run_folder(tmp_path, "gswm", 0, status="failed", reason="No space left for last.ckpt: free some.")
    run = only(tmp_path)
    assert (run.state, run.failure) == ("unfinished", None)
    assert run.why == "its last word is: No space left for last.ckpt: free some."


@pytest.mark.parametrize(
    ("share", "failed"),
    [
        (0.0, True),
        (0.000999, True),
        (0.001, False),
        (0.3, False),
        (0.999, False),
        (0.9991, True),
        (1.0, True),
        (None, False),
    ],
)
def test_failed_by_the_share_of_pixels_given_to_objects(share: float | None, failed: bool, tmp_path: Path) -> None:
    run_folder(tmp_path, "gswm", 0, foreground_share=share)
    assert (only(tmp_path).failure is not None) == failed


def test_the_share_of_an_evaluation_of_the_validation_split(tmp_path: Path) -> None:
    folder = run_folder(tmp_path, "gswm", 0)
    change(folder, "metrics.json", ("splits", "val"), {"foreground_share": 0.9999, "total": {}})
    assert only(tmp_path).failure == "it gives 99.990 % of the validation pixels to objects"
    change(folder, "run.json", ("foreground_share",), 0.5)
    assert only(tmp_path).failure is None


def test_the_test_split_does_not_decide_on_failure(tmp_path: Path) -> None:
    change(run_folder(tmp_path, "gswm", 0), "metrics.json", ("splits", "test", "foreground_share"), 0.0)
    assert only(tmp_path).failure is None


def test_settings_and_data_of_the_split_come_before_those_of_the_file(tmp_path: Path) -> None:
    folder = run_folder(tmp_path, "apex", 0)
    before = only(tmp_path).protocol
    change(
        folder, "metrics.json", ("splits", "test", "settings"), {"scoring": {"first_frame": 0, "identities": "none"}}
    )
    assert only(tmp_path).protocol == before
    said = {"first_frame": 0, "masks": "model"}  # earlier versions did not say which masks
    change(folder, "metrics.json", ("splits", "test", "settings"), {"scoring": said})
    assert only(tmp_path).protocol == before
    change(folder, "metrics.json", ("splits", "test", "settings"), {"scoring": {**said, "masks": "posterior"}})
    assert only(tmp_path).protocol != before
    change(folder, "metrics.json", ("splits", "test", "settings"), {"scoring": {"first_frame": 2}})
    change(folder, "metrics.json", ("splits", "test", "data_fingerprint"), "e" * 32)
    after = only(tmp_path).protocol
    assert before is not None
    assert after is not None
    assert (before.data_fingerprint, after.data_fingerprint) == ("d" * 32, "e" * 32)
    assert before.scoring != after.scoring


def test_a_low_score_is_no_failure(tmp_path: Path) -> None:
    run_folder(tmp_path, "gswm", 0, {"ari_fg": 0.0, "mota": -900.0}, foreground_share=0.2)
    assert only(tmp_path).failure is None


def change(folder: Path, name: str, keys: tuple[str, ...], value: Any) -> None:
    content = json.loads((folder / name).read_text())
    inner = content
    for key in keys[:-1]:
        inner = inner[key]
    inner[keys[-1]] = value
    (folder / name).write_text(json.dumps(content))


TOTAL = ("splits", "test", "total")


@pytest.mark.parametrize(
    ("name", "keys", "value", "told"),
    [
        ("run.json", ("status",), "done", "run.json: status = 'done' is wrong"),
        ("run.json", ("seed",), "0", "run.json is damaged: seed = '0' is wrong"),
        ("run.json", ("seed",), 5, "run.json is of seed 5, but its folder is seed_0"),
        ("run.json", ("foreground_share",), "much", "run.json is damaged: foreground_share = 'much' is wrong"),
        ("metrics.json", ("splits",), [], "metrics.json has no 'splits'"),
        ("metrics.json", ("splits",), {"val": {}}, "metrics.json has no scores of the split 'test' (it has val)"),
        ("metrics.json", TOTAL, 3, "metrics.json has no 'splits.test.total'"),
        ("metrics.json", (*TOTAL, "ari"), "0.5", "metrics.json: splits.test.total.ari = '0.5' is no number"),
        ("metrics.json", (*TOTAL, "ari"), True, "metrics.json: splits.test.total.ari = true is no number"),
        ("metrics.json", ("splits", "test", "videos"), -1, "metrics.json: videos = -1 is no count"),
    ],
)
def test_wrong_content_is_told_with_its_file(
    name: str, keys: tuple[str, ...], value: Any, told: str, tmp_path: Path
) -> None:
    change(run_folder(tmp_path, "apex", 0), name, keys, value)
    run = only(tmp_path)
    assert run.state == "damaged"
    assert told in str(run.why)
    assert str(run.folder) in str(run.why)


@pytest.mark.parametrize("name", ["run.json", "metrics.json"])
@pytest.mark.parametrize("content", [b"", b'{"status": "fini', b"[1]", b"\xff\xfe\x00", b"null"])
def test_damaged_files_are_told_in_one_sentence(name: str, content: bytes, tmp_path: Path) -> None:
    folder = run_folder(tmp_path, "apex", 0)
    (folder / name).write_bytes(content)
    run = only(tmp_path)
    assert run.state == "damaged"
    assert str(folder / name) in str(run.why)
    assert "\n" not in str(run.why)


@pytest.mark.parametrize("name", ["run.json", "metrics.json"])
def test_missing_files(name: str, tmp_path: Path) -> None:
    folder = run_folder(tmp_path, "apex", 0)
    (folder / name).unlink()
    assert only(tmp_path).why == f"{folder / name} is missing: run the command of this run again."


def test_infinity_is_undefined(tmp_path: Path) -> None:
    folder = run_folder(tmp_path, "apex", 0)
    text = (folder / "metrics.json").read_text()
    (folder / "metrics.json").write_text(text.replace('"mota": 40.0', '"mota": -Infinity'))
    assert math.isnan(only(tmp_path).scores["mota"])


def test_arrangement(tmp_path: Path) -> None:
    folder = run_folder(tmp_path, "apex", 0)
    run = only(tmp_path)
    assert read_arrangement(run) is None
    (folder / "arrangement.json").write_text('{"distances_m": {"2": [[0.5, null]], "3": []}}')
    found = read_arrangement(run)
    assert found is not None
    assert found["3"] == []
    assert found["2"][0][0] == 0.5
    assert math.isnan(found["2"][0][1])


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("{", "cannot be read"),
        ("{}", "has no 'distances_m'"),
        ('{"distances_m": {"two": []}}', "distances_m.two is wrong"),
        ('{"distances_m": {"2": 0.5}}', "distances_m.2 is wrong"),
        ('{"distances_m": {"2": [[0.1, 0.2], [0.1]]}}', "scenario 1 of distances_m.2 needs 2 distances"),
        ('{"distances_m": {"2": [[0.1, "far"]]}}', "distances_m.2 = 'far' is no number"),
    ],
)
def test_damaged_arrangement(content: str, told: str, tmp_path: Path) -> None:
    folder = run_folder(tmp_path, "apex", 0)
    (folder / "arrangement.json").write_text(content)
    with pytest.raises(UserError) as error:
        read_arrangement(only(tmp_path))
    assert told in str(error.value)
    assert str(folder / "arrangement.json") in str(error.value)
