"""The commands for missing runs: exact, complete, and none for what is there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from apex_lab.tables.asked import assemble
from apex_lab.tables.found import collect
from apex_lab.tables.missing_runs import Command
from tests.tables.folders import VERSION, job, made, run_folder


def commands(outputs: Path, **asked: Any) -> list[Command]:
    return made(outputs, **asked)[1]


def of(found: list[Command], label: str) -> Command:
    return next(command for command in found if command.remarks[0].startswith(f"{label}, "))


def test_an_empty_folder_gives_every_command(tmp_path: Path) -> None:
    found = commands(tmp_path, tables=(1, 2, 3, 4), yardsticks=True)
    outputs = str(tmp_path)
    train = "python -m apex_lab.train model="
    assert [command.text for command in found] == [
        *(
            f"{train}{m} seed=0,1,2,3 scale=paper -m"
            for m in ("op3", "scalor", "gswm", "space", "slot_attention", "apex")
        ),
        *(
            f"{train}{model} seed=0 scale=paper"
            for model in ("color_clusters", "background_subtraction", "oracle", "one_segment")
        ),
        *(
            f"{train}apex +ablation={ablation} seed=0,1,2,3 scale=paper -m"
            for ablation in ("image_stn", "no_entropy", "scalor_norm", "gaussian", "gaussian_scalor_norm")
        ),
        *(
            f"python -m apex_lab.arrange 'checkpoint={outputs}/{model}_p2d_paper_*/seed_0'"
            for model in ("space", "scalor", "gswm", "apex")
        ),
    ]
    assert of(found, "SCALOR").remarks == ("SCALOR, tables 1, 2, 2b, 4", "not in this version")
    assert of(found, "APEX").remarks == ("APEX, tables 1, 2, 2b, 3, 4",)
    assert of(found, "Oracle").remarks == ("Oracle, tables 1, 2, 2b, 3",)
    assert found[-1].remarks == ("APEX, table 4", "not in this version")


def test_only_what_is_missing_unfinished_or_damaged(tmp_path: Path) -> None:
    run_folder(tmp_path, "apex", 1)
    run_folder(tmp_path, "apex", 2, status="running")
    (run_folder(tmp_path, "apex", 3) / "run.json").write_text("")
    assert of(commands(tmp_path), "APEX").text == "python -m apex_lab.train model=apex seed=0,2,3 scale=paper -m"
    run_folder(tmp_path, "apex", 0)
    assert of(commands(tmp_path, seeds=(0, 1)), "APEX").text == (
        "python -m apex_lab.train model=apex seed=2,3 scale=paper -m"
    )


def test_a_complete_row_needs_no_command(tmp_path: Path) -> None:
    for seed in (4, 5, 6, 7):
        run_folder(tmp_path, "apex", seed)
    assert not any(command.remarks[0].startswith("APEX") for command in commands(tmp_path))


def test_one_seed_is_no_sweep(tmp_path: Path) -> None:
    for seed in range(3):
        run_folder(tmp_path, "apex", seed)
    assert of(commands(tmp_path), "APEX").text == "python -m apex_lab.train model=apex seed=3 scale=paper"


def test_failed_seeds_are_not_run_again(tmp_path: Path) -> None:
    for seed in range(4):
        run_folder(tmp_path, "gswm", seed, foreground_share=0.0)
    assert not any(command.remarks[0].startswith("G-SWM") for command in commands(tmp_path))


def test_another_configuration_is_told(tmp_path: Path) -> None:
    run_folder(tmp_path, "apex", 0, hash8="ffffffff")
    found = of(commands(tmp_path), "APEX")
    assert found.text == "python -m apex_lab.train model=apex seed=1,2,3 scale=paper -m"
    assert found.remarks[1] == "its other seeds have another configuration; seed=0,1,2,3 makes the whole row again"


def test_changed_values_are_not_what_the_row_asks_for_unless_their_group_is(tmp_path: Path) -> None:
    for seed in range(3):
        run_folder(tmp_path, "apex", seed, hash8="ffffffff", overrides=["optimizer.lr=1e-3", "scale=paper", "seed=0"])
    found = of(commands(tmp_path), "APEX")
    assert found.text == "python -m apex_lab.train model=apex seed=0,1,2,3 scale=paper -m"
    assert found.remarks[1] == "without the changed values"
    asked = of(commands(tmp_path, groups=("apex_p2d_paper_ffffffff",)), "APEX")
    assert asked.text == "python -m apex_lab.train model=apex seed=3 scale=paper optimizer.lr=1e-3"


def test_data_and_places_are_named_and_quoted(tmp_path: Path) -> None:
    checked = replace(job(tmp_path, tables=(1,)), data="sketchy", paths=("paths.outputs=my runs",))
    found = assemble(collect(tmp_path), checked, VERSION)[1]
    assert of(found, "APEX").text == (
        "python -m apex_lab.train model=apex seed=0,1,2,3 data=sketchy scale=paper 'paths.outputs=my runs' -m"
    )


def test_arranging_needs_one_seed_that_has_not_failed(tmp_path: Path) -> None:
    run_folder(tmp_path, "gswm", 0, foreground_share=0.0)
    run_folder(tmp_path, "gswm", 1, foreground_share=0.3)
    version = replace(VERSION, arrange=True, models={*VERSION.models, "gswm"})
    found = [command for command in made(tmp_path, version, tables=(4,))[1] if "G-SWM" in command.remarks[0]]
    assert [str(command) for command in found] == [
        f"python -m apex_lab.arrange checkpoint={tmp_path}/gswm_p2d_paper_0123abcd/seed_1  # G-SWM, table 4"
    ]
