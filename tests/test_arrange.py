"""The command itself."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from sims.arrangement.settings import Settings
from sims.arrangement_clips.settings import Settings as ClipSettings
from tests.conftest import REPOSITORY, Ended

pytest.importorskip("pybullet")

REFUSED = {
    "": "checkpoint is missing: write checkpoint=..., perception=oracle or perception=color_clusters.",
    "checkpoint=nowhere.ckpt": "checkpoint = nowhere.ckpt does not exist: give a .ckpt file or a run folder.",
    "perception=oracle checkpoint=x": "perception=oracle needs no checkpoint: leave one of the two out.",
    "perception=oracle tasks=[9]": "tasks = [9]: a task of 9 objects needs as many names in objects",
    "perception=oracle tasks=[]": "tasks = [] is wrong",
    "perception=oracle tasks=[2,3,2]": "tasks = [2, 3, 2] names one twice: name each once.",
    "perception=oracle video=[2/0,2/00]": "video = ['2/0', '2/00'] names one twice: name each once.",
    "perception=oracle simulation.planning_limit=0": "simulation.planning_limit = 0 is wrong",
    "perception=oracle scenarios=0": "scenarios = 0 is wrong",
    "perception=oracle video=[4-17]": "video = '4-17' is no scenario: write objects/index, such as video=[4/17].",
    "perception=oracle video=[7/1]": "video = '7/1': a task of 7 objects needs",
    "perception=oracle ++simulation.dept=stereo": "Unknown key simulation.dept = 'stereo'; did you mean 'depth'?",
    "perception=oracle simulation.depth=lidar": "simulation.depth = 'lidar' is wrong",
    "perception=oracle simulation.objects=[mug]": "the gripper cannot grasp",
    "perception=color_clusters perception.model.colors=1": "perception.model.colors = 1 is wrong",
    "perception=oracle worker=2": "worker",
}


@pytest.mark.parametrize("words", REFUSED)
def test_refuses_before_anything_is_written(words: str, command: Callable[..., Ended], tmp_path: Path) -> None:
    ended = command("arrange", *words.split())
    assert (ended.code, ended.out) == (2, "")
    assert REFUSED[words] in ended.err
    assert len(ended.err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_the_files_show_the_simulation_s_own_values() -> None:
    shown = yaml.safe_load((REPOSITORY / "conf" / "arrange.yaml").read_text())["simulation"]
    assert Settings(**shown) == Settings()
    shown = yaml.safe_load((REPOSITORY / "conf" / "data" / "arrangement.yaml").read_text())["simulation"]
    assert ClipSettings(**shown) == ClipSettings()


@pytest.mark.slow
def test_the_oracle_arranges_resumes_and_is_filmed(command: Callable[..., Ended], tmp_path: Path) -> None:
    words = ("perception=oracle", "tasks=[2]", "workers=1")
    first = command("arrange", *words, "scenarios=1")
    assert first.code == 0, first.err
    [file] = tmp_path.glob("outputs/arrange/oracle/arrangement/*/scenarios/2_000.json")
    before = file.read_bytes()
    again = command("arrange", *words, "scenarios=2")
    assert again.code == 0, again.err
    assert file.read_bytes() == before  # it was not run again
    content = json.loads((file.parent.parent / "arrangement.json").read_text())
    assert content["tasks"]["2"]["scenarios"] == 2
    assert content["tasks"]["2"]["mean_m"] < 0.02
    file.write_text(before.decode()[:-30])
    filmed = command("arrange", *words, "video=[2/0]", "simulation.video_fps=2")
    assert filmed.code == 0, filmed.err
    assert Path(filmed.out.splitlines()[-1]).stat().st_size > 10_000
    assert command("arrange", *words, "scenarios=2").code == 0
    redone = json.loads(file.read_text())
    assert {k: v for k, v in redone.items() if k != "seconds"} == {
        k: v for k, v in json.loads(before).items() if k != "seconds"
    }


@pytest.mark.slow
def test_a_run_s_own_folder_takes_the_row_of_the_table_alone(trained: Path, command: Callable[..., Ended]) -> None:
    ended = command("arrange", f"checkpoint={trained}", "trust=true", "tasks=[2]", "scenarios=1", "workers=1")
    assert ended.code == 0, ended.err
    assert not (trained / "arrangement.json").exists()
    [summary] = trained.glob("arrangement/*/arrangement.json")
    assert json.loads(summary.read_text())["perception"]["min_presence"] == 0.5
