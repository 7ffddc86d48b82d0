"""Which runs stand in a row, by which rule, and what is said of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from apex_lab.base.errors import UserError
from apex_lab.tables.choose import REASONS, Choice, Version, choose
from apex_lab.tables.found import collect
from tests.tables.folders import VERSION, made, run_folder


def chosen(outputs: Path, *asked: str, version: Version = VERSION, ablation: str | None = None) -> Choice:
    return choose(collect(outputs), ("apex", ablation), "p2d", "paper", asked, version)


def name(choice: Choice) -> str:
    assert choice.group is not None
    return choice.group.name.removeprefix("apex_p2d_paper_")


def test_other_models_ablations_scales_data_and_experiments_are_no_candidates(tmp_path: Path) -> None:
    run_folder(tmp_path, "apex", 0, scale="cpu")
    run_folder(tmp_path, "apex", 0, data="sketchy")
    run_folder(tmp_path, "apex", 0, ablation="gaussian")
    run_folder(tmp_path, "apex_two", 0)
    run_folder(tmp_path, "apex", 0, hash8="11111111", experiment="overfit")
    run_folder(tmp_path, "apex", 0, hash8="22222222", tuned="sigma")
    assert chosen(tmp_path) == Choice(None)
    assert chosen(tmp_path, ablation="gaussian").group is not None


def test_an_experiment_can_be_asked_for(tmp_path: Path) -> None:
    run_folder(tmp_path, "apex", 0, hash8="11111111", experiment="overfit", overrides=["+experiment=overfit"])
    choice = chosen(tmp_path, "apex_p2d_paper_11111111")
    assert name(choice) == "11111111"
    assert choice.notes == ("its command changed values: +experiment=overfit.",)


def test_words_are_compared_one_by_one_not_as_a_name(tmp_path: Path) -> None:
    folder = run_folder(tmp_path, "apex", 0)
    run_folder(tmp_path, "apex_p2d", 0, data=None, hash8="0000ffff")
    assert (chosen(tmp_path).group or 0).runs[0].folder == folder  # type: ignore[union-attr]


def test_the_configuration_of_this_version_comes_first(tmp_path: Path) -> None:
    run_folder(tmp_path, "apex", 0)
    for seed in range(4):
        run_folder(tmp_path, "apex", seed, hash8="ffffffff")
    choice = chosen(tmp_path)
    assert name(choice) == "0123abcd"
    assert choice.notes == (
        "2 configurations fit: apex_p2d_paper_0123abcd is taken because it is what this version's command makes; "
        "not apex_p2d_paper_ffffffff.",
    )


def test_a_group_that_is_asked_for_comes_before_all(tmp_path: Path) -> None:
    run_folder(tmp_path, "apex", 0)
    run_folder(tmp_path, "apex", 0, hash8="ffffffff", overrides=["model.hidden=8"])
    choice = chosen(tmp_path, "apex_p2d_paper_ffffffff")
    assert name(choice) == "ffffffff"
    assert "because it was asked for" in choice.notes[0]
    assert choice.notes[1] == "its command changed values: model.hidden=8."


OTHER = {"hash8": "11111111"}, {"hash8": "22222222"}


@pytest.mark.parametrize(
    ("first", "second", "reason"),
    [
        ({"status": "running"}, {}, "it has results"),
        ({"overrides": ["model=apex", "optimizer.lr=1"]}, {"overrides": ["trainer=gpu", "logger=wandb"]}, REASONS[3]),
        ({"started": "2026-05-01"}, {"started": "2026-06-01"}, "it was started last"),
        ({"started": None}, {"started": None}, "its name comes last"),
    ],
)
def test_the_first_reason_that_tells_them_apart_decides(first: dict, second: dict, reason: str, tmp_path: Path) -> None:
    run_folder(tmp_path, "apex", 0, hash8="11111111", **first)
    run_folder(tmp_path, "apex", 0, hash8="22222222", **second)
    choice = chosen(tmp_path)
    assert name(choice) == "22222222"
    assert f"because {reason};" in choice.notes[0]
    assert choice.notes[-1] == "its configuration is not the one that this version's command makes."


def test_more_seeds_win(tmp_path: Path) -> None:
    for seed in range(2):
        run_folder(tmp_path, "apex", seed, hash8="11111111")
    run_folder(tmp_path, "apex", 9, hash8="22222222")
    choice = chosen(tmp_path)
    assert name(choice) == "11111111"
    assert "because it has the most seeds with results;" in choice.notes[0]


def test_a_configuration_that_cannot_be_compared_is_not_called_another_one(tmp_path: Path) -> None:
    run_folder(tmp_path, "apex", 0, fingerprint=None)
    assert chosen(tmp_path).notes == ()
    without = Version(models=(), ablations=(), fingerprint=lambda words: None)
    assert chosen(tmp_path, version=without).notes == ()


@pytest.mark.parametrize(
    ("odd", "told"),
    [
        ({"data_fingerprint": "e" * 32}, "other data (fingerprint eeeeeeee) than for the other seeds."),
        ({"data_fingerprint": None}, "other data (fingerprint unknown) than for the other seeds."),
        ({"videos": 100}, "other videos (100 with 2000 frames) than for the other seeds."),
        ({"metrics": {"settings": {"scoring": None}}}, "other settings of the evaluation than for the other seeds."),
        ({"fingerprint": "f" * 64}, "its configuration is another one than its folder's other seeds have."),
    ],
)
def test_seeds_that_cannot_stand_beside_the_others_are_left_out(odd: dict, told: str, tmp_path: Path) -> None:
    for seed in (0, 2):
        run_folder(tmp_path, "apex", seed, {"ari": 0.5})
    run_folder(tmp_path, "apex", 1, {"ari": 1.0}, **odd)
    choice = chosen(tmp_path)
    assert choice.group is not None
    assert sorted(choice.group.runs) == [0, 2]
    assert choice.group.left_out == {1: told}
    assert choice.notes == (f"seed 1 is left out: {told}",)
    (table,), _, _ = made(tmp_path)
    summary = table.lines[-1].cells["ari"].summary
    assert summary is not None
    assert (summary.n, summary.mean) == (2, 0.5)
    assert table.lines[-1].seeds == "2 of 4"


def test_a_run_whose_record_is_damaged_is_found_by_its_folder_s_name(tmp_path: Path) -> None:
    (run_folder(tmp_path, "apex", 0, ablation="gaussian") / "run.json").write_text("{")
    (run_folder(tmp_path, "apex", 0, scale="cpu") / "run.json").write_text("{")
    choice = chosen(tmp_path, ablation="gaussian")
    assert choice.group is not None
    assert choice.group.runs[0].state == "damaged"
    assert chosen(tmp_path) == Choice(None)


def test_groups_that_are_not_there_or_fit_no_row(tmp_path: Path) -> None:
    run_folder(tmp_path, "apex", 0, scale="cpu")
    with pytest.raises(UserError, match=r"groups: there are no runs in .*apex_p2d_paper_00000000"):
        made(tmp_path, groups=("apex_p2d_paper_00000000",))
    with pytest.raises(UserError, match="groups: apex_p2d_cpu_0123abcd fits no row"):
        made(tmp_path, groups=("apex_p2d_cpu_0123abcd",))
