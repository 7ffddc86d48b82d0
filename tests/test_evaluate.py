from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from tests.conftest import Ended


@pytest.fixture
def trained(train: Callable[..., Ended], the_run: Callable[..., Path]) -> Path:
    assert train().code == 0
    return the_run()


def test_a_run_scores_again_as_at_its_end(trained: Path, command: Callable[..., Ended]) -> None:
    ended = command("evaluate", f"checkpoint={trained}", "pictures=1")
    assert ended.code == 0
    folder = trained / "evaluate" / "last_test"
    again, before = (json.loads((path / "metrics.json").read_text()) for path in (folder, trained))
    assert again["splits"] == before["splits"]
    lines = ended.out.splitlines()
    assert lines[1].split() == ["ARI-FG", "MSC-FG", "ARI", "MSC"]
    paths = [Path(line) for line in lines[3:]]
    assert paths[0] == folder / "metrics.json"
    assert paths[1] == folder / "view" / "film_strip.png"
    assert all(path.is_file() for path in paths)


def test_split_videos_and_folder_are_chosen(trained: Path, command: Callable[..., Ended], tmp_path: Path) -> None:
    words = ("split=val", "videos=1", "pictures=0", "folder=elsewhere")
    ended = command("evaluate", f"checkpoint={trained}/checkpoints/best.ckpt", *words)
    assert ended.code == 0
    stored = json.loads((tmp_path / "elsewhere" / "metrics.json").read_text())
    assert (stored["splits"]["val"]["videos"], stored["splits"]["val"]["frames"]) == (1, 3)
    assert stored["settings"]["split"] == "val"
    assert "scoring" in stored["settings"]


def test_a_checkpoint_alone_is_enough(trained: Path, command: Callable[..., Ended], tmp_path: Path) -> None:
    alone = tmp_path / "shipped.ckpt"
    alone.write_bytes((trained / "checkpoints" / "last.ckpt").read_bytes())
    ended = command("evaluate", "checkpoint=shipped.ckpt", "pictures=0", f"paths.data={tmp_path / 'data'}")
    assert ended.code == 0
    assert (tmp_path / "outputs" / "evaluate" / "shipped_test" / "metrics.json").is_file()


def refused(ended: Ended, told: str) -> None:
    assert ended.code == 2
    assert told in ended.err
    assert len(ended.err.splitlines()) == 1


def test_what_cannot_be_evaluated_is_told(trained: Path, command: Callable[..., Ended], tmp_path: Path) -> None:
    (tmp_path / "text.ckpt").write_text("text")
    torch.save({"a": 1}, tmp_path / "other.ckpt")
    group = trained.parent.relative_to(tmp_path)
    for word, told in {
        "checkpoint=nowhere.ckpt": "checkpoint = nowhere.ckpt does not exist: give a .ckpt file or a run folder.",
        "checkpoint=text.ckpt": "text.ckpt is no checkpoint, or its end is missing",
        "checkpoint=other.ckpt": "other.ckpt is no apex_lab checkpoint",
        f"checkpoint={group}": f"checkpoint = {group} is a folder without checkpoints/last.ckpt; it holds seed_0",
        "checkpiont=x": "Unknown key checkpiont = 'x'; did you mean 'checkpoint'?",
        "split=val": "checkpoint is missing: write checkpoint=...",
        "++nothing=1": "Unknown key nothing = 1.",
    }.items():
        refused(command("evaluate", word), told)
    words = [f"checkpoint={trained}"]
    refused(
        command("evaluate", *words, "split=tst"), "split = 'tst' is wrong: input should be 'train', 'val' or 'test'."
    )
    refused(command("evaluate", *words, "videos=0"), "videos = 0 is wrong")


def test_weights_of_another_model_are_refused(trained: Path, command: Callable[..., Ended], tmp_path: Path) -> None:
    content = torch.load(trained / "checkpoints" / "last.ckpt", weights_only=True)
    content["config"]["model"]["width"] = 5
    torch.save(content, tmp_path / "other.ckpt")
    ended = command("evaluate", "checkpoint=other.ckpt")
    assert ended.code == 1
    assert "The weights in other.ckpt do not fit its model:" in ended.err
    content["config"]["model"]["depth"] = 5
    torch.save(content, tmp_path / "other.ckpt")
    refused(command("evaluate", "checkpoint=other.ckpt"), "was made by another version of apex_lab: Unknown key")
