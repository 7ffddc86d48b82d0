"""The commands for missing runs: exact, complete, and none for what is there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from apex_lab.tables.missing_runs import Command, missing_runs
from tests.tables.folders import job, jobs, made, run_folder

YARDSTICKS = ("color_clusters", "background_subtraction", "oracle", "one_segment")


def commands(outputs: Path, **asked: Any) -> tuple[Command, ...]:
    return made(outputs, **asked)[1]


def of(found: tuple[Command, ...], label: str) -> Command:
    return next(command for command in found if command.remarks[0].startswith(f"{label}, "))


def test_an_empty_folder_gives_every_command(tmp_path: Path) -> None:
    found = commands(tmp_path, tables=(1, 2, 3, 4), yardsticks=True)
    train = "python -m apex_lab.train model="
    assert found[0] == Command("python -m apex_lab.train +sweep=some -m", ("all that is missing",))
    assert [command.text for command in found[1:]] == [
        *(
            f"{train}{m} seed=0,1,2,3 scale=paper -m"
            for m in ("op3", "scalor", "gswm", "space", "slot_attention", "apex")
        ),
        *(f"{train}{model} seed=0 scale=paper" for model in YARDSTICKS),
        *(
            f"{train}apex +ablation={ablation} seed=0,1,2,3 scale=paper -m"
            for ablation in ("image_stn", "no_entropy", "scalor_norm", "gaussian", "gaussian_scalor_norm")
        ),
        *(
            f"python -m apex_lab.arrange checkpoint={tmp_path}/{model}_p2d_paper_0123abcd/seed_0"
            for model in ("space", "scalor", "gswm", "apex", *YARDSTICKS)
        ),
    ]
    assert of(found, "SCALOR").remarks == ("SCALOR, tables 1, 2, 2b, 4",)
    assert of(found, "APEX").remarks == ("APEX, tables 1, 2, 2b, 3, 4",)
    assert of(found, "Oracle").remarks == ("Oracle, tables 1, 2, 2b, 3, 4",)
    assert found[-1].remarks == ("One segment, data=p2d, table 4",)


def test_only_what_is_missing_unfinished_or_damaged(tmp_path: Path) -> None:
    run_folder(tmp_path, "apex", 1)
    run_folder(tmp_path, "apex", 2, status="running")
    (run_folder(tmp_path, "apex", 3) / "run.json").write_text("")
    assert of(commands(tmp_path), "APEX").text == "python -m apex_lab.train model=apex seed=0,2,3 scale=paper -m"
    run_folder(tmp_path, "apex", 0)
    assert of(commands(tmp_path, seeds=(0, 3)), "APEX").text == "python -m apex_lab.train model=apex seed=3 scale=paper"


def test_a_complete_row_needs_no_command(tmp_path: Path) -> None:
    for seed in (4, 5):
        run_folder(tmp_path, "apex", seed)
    found = commands(tmp_path, seeds=(4, 5))
    assert not any(command.remarks[0].startswith("APEX") for command in found)
    assert commands(tmp_path, jobs=[job(tmp_path, "apex", 4)]) == ()


def test_one_row_needs_no_command_for_all(tmp_path: Path) -> None:
    (command,) = commands(tmp_path, jobs=[job(tmp_path, "apex", seed) for seed in (0, 1)])
    assert command.text == "python -m apex_lab.train model=apex seed=0,1 scale=paper -m"


def test_the_command_for_all_is_there_only_where_it_runs_no_more(tmp_path: Path) -> None:
    assert commands(tmp_path, yardsticks=True)[0].remarks == ("all that is missing",)
    assert commands(tmp_path, yardsticks=False)[0].remarks == ("OP3, table 1",)  # it would run the yardsticks too
    assert commands(tmp_path, yardsticks=True, jobs=jobs(tmp_path, (1, 3), (0,)))[0].remarks == ("OP3, table 1",)


def test_seeds_that_failed_by_the_rule_are_not_run_again(tmp_path: Path) -> None:
    for seed in range(4):
        run_folder(tmp_path, "gswm", seed, foreground_share=0.0)
    assert not any(command.remarks[0].startswith("G-SWM") for command in commands(tmp_path))


def test_a_sweep_is_asked_to_try_failed_runs_again(tmp_path: Path) -> None:
    run_folder(tmp_path, "apex", 0, status="failed", outcome="failed", reason="No space left.")
    found = commands(tmp_path, yardsticks=True)
    assert found[0].text == "python -m apex_lab.train +sweep=some hydra.sweeper.retry_failed=true -m"
    retried = "python -m apex_lab.train model=apex seed=0,1,2,3 scale=paper hydra.sweeper.retry_failed=true -m"
    assert of(found, "APEX").text == retried
    assert "retry" not in of(found, "OP3").text


@pytest.mark.parametrize("outcome", ["paused", "interrupted"])
def test_stopped_runs_are_resumed_without_being_asked_to(outcome: str, tmp_path: Path) -> None:
    run_folder(tmp_path, "apex", 0, status="paused" if outcome == "paused" else "failed", outcome=outcome, reason="x")
    assert of(commands(tmp_path), "APEX").text == "python -m apex_lab.train model=apex seed=0,1,2,3 scale=paper -m"


def test_words_of_the_jobs_are_kept_and_quoted(tmp_path: Path) -> None:
    listed = [
        job(tmp_path, "apex", seed, "gaussian", data="sprites", scale="cpu", words=("paths.outputs=my runs",))
        for seed in (0, 1)
    ]
    (command,) = commands(tmp_path, tables=(3,), jobs=listed)
    assert command.text == (
        "python -m apex_lab.train model=apex +ablation=gaussian seed=0,1 data=sprites scale=cpu "
        "'paths.outputs=my runs' -m"
    )


def test_arranging_needs_one_seed_that_has_not_failed(tmp_path: Path) -> None:
    run_folder(tmp_path, "gswm", 0, foreground_share=0.0)
    run_folder(tmp_path, "gswm", 1, foreground_share=0.3)
    tables, _ = made(tmp_path, tables=(4,))
    found = missing_runs(tables, None, ("gswm",))
    assert [
        str(command) for command in found if command.remarks[0].startswith("G-SWM, ") and "arrange" in command.text
    ] == [
        f"python -m apex_lab.arrange checkpoint={tmp_path}/gswm_p2d_paper_0123abcd/seed_1  # G-SWM, data=p2d, table 4"
    ]
