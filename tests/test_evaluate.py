"""The command itself; what it does is tested in tests/evaluation."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from tests.conftest import REPOSITORY, Ended


def test_a_run_scores_again_as_at_its_end(trained: Path, command: Callable[..., Ended]) -> None:
    before = json.loads((trained / "metrics.json").read_text())
    ended = command("evaluate", f"checkpoint={trained}")
    assert ended.code == 0
    again = json.loads((trained / "metrics.json").read_text())
    for key in ("total", "per_video", "hota_alpha", "by_property", "foreground_share", "seed", "versions"):
        assert again["splits"]["test"][key] == before["splits"]["test"][key], key
    assert again["splits"]["test"]["settings"]["scoring"] == before["splits"]["test"]["settings"]["scoring"]
    share = json.loads((trained / "run.json").read_text())["foreground_share"]
    assert before["validation_foreground_share"] == again["validation_foreground_share"] == share
    paths = [Path(line) for line in ended.out.splitlines()[5:]]
    view = trained / "view" / "test"
    assert paths[:2] == [trained / "metrics.json", view / "film_strip.png"]
    assert {path.name for path in view.glob("best_*")} == set()
    assert [path.name.split("_test_")[0] for path in paths[4:6]] == ["components_best", "components_worst"]
    assert paths[6] == view / "curves.png"
    assert all(path.is_file() for path in paths)


def test_a_checkpoint_alone_is_enough(trained: Path, command: Callable[..., Ended], tmp_path: Path) -> None:
    alone = tmp_path / "shipped.ckpt"
    alone.write_bytes((trained / "checkpoints" / "last.ckpt").read_bytes())
    ended = command("evaluate", "checkpoint=shipped.ckpt", "pictures=0", f"paths.data={tmp_path / 'data'}")
    assert ended.code == 0
    assert len(list((tmp_path / "outputs" / "evaluate").glob("shipped_*_test/metrics.json"))) == 1
    # weights of another model, a configuration of another version, files that are no checkpoints
    content = torch.load(alone, weights_only=True)
    content["inference"]["model"]["width"] = 5
    torch.save(content, tmp_path / "other.ckpt")
    ended = command("evaluate", "checkpoint=other.ckpt")
    assert ended.code == 1
    assert "other.ckpt: The weights do not fit their model:" in ended.err
    content["config"]["model"]["depth"] = 5
    torch.save(content, tmp_path / "other.ckpt")
    told = "holds a configuration that this version of apex_lab refuses: Unknown key"
    refused(command("evaluate", "checkpoint=other.ckpt"), told)


def test_predictions_of_another_program(command: Callable[..., Ended]) -> None:
    public = REPOSITORY / "tests" / "metrics" / "fixtures" / "metrics_public.npz"
    ended = command("evaluate", f"predictions={public}", "output=scores.json")
    assert ended.code == 0
    assert json.loads(Path("scores.json").read_text())["total"]["videos"] == 8


def refused(ended: Ended, told: str) -> None:
    assert ended.code == 2
    assert told in ended.err
    assert len(ended.err.splitlines()) == 1


def test_what_cannot_be_evaluated_is_told(command: Callable[..., Ended], tmp_path: Path) -> None:
    (tmp_path / "text.ckpt").write_text("text")
    torch.save({"a": 1}, tmp_path / "other.ckpt")
    for word, told in {
        "checkpoint=nowhere.ckpt": "checkpoint = nowhere.ckpt does not exist: give a .ckpt file or a run folder.",
        "checkpoint=text.ckpt": "text.ckpt is no checkpoint, or its end is missing",
        "checkpoint=other.ckpt": "other.ckpt is no apex_lab checkpoint",
        "checkpoint=[]": "checkpoint = [] names no file",
        "checkpiont=x": "Unknown key checkpiont = 'x'; did you mean 'checkpoint'?",
        "split=val": "checkpoint is missing: write checkpoint=... or, for another program's, predictions=...",
        "split=tst": "split = 'tst' is wrong: input should be 'train', 'val' or 'test'.",
        "videos=0": "videos = 0 is wrong",
        "++nothing=1": "Unknown key nothing = 1.",
    }.items():
        refused(command("evaluate", word), told)


@pytest.mark.parametrize("words", [("data.data_seed=1",), ("data.test=3", "data.frames=4")])
def test_other_data_are_scored_in_a_folder_of_their_own_that_says_which(
    words: tuple[str, ...], trained: Path, command: Callable[..., Ended]
) -> None:
    before = (trained / "metrics.json").read_bytes()
    ended = command("evaluate", f"checkpoint={trained}", "pictures=0", *words)
    assert ended.code == 0, ended.err
    assert (trained / "metrics.json").read_bytes() == before
    [file] = trained.glob("evaluate/last_test_data_*/metrics.json")
    found, own = (json.loads(text)["splits"]["test"] for text in (file.read_text(), before))
    assert found["data_fingerprint"] == found["data"]["fingerprint"] != own["data_fingerprint"]
    asked = {word.removeprefix("data.").partition("=")[0]: int(word.partition("=")[2]) for word in words}
    settings = found["data"]["settings"]
    assert [settings["seed" if key == "data_seed" else key] for key in asked] == list(asked.values())
    assert found["videos"] == settings["test"]
    assert found["total"]["ari"] != own["total"]["ari"]


def test_videos_without_labels_are_drawn_and_exported_but_not_scored(
    trained: Path, command: Callable[..., Ended]
) -> None:
    ended = command("evaluate", f"checkpoint={trained}", "data.labelled=false", "pictures=1", "export=npz")
    assert ended.code == 0, ended.err
    assert "test: 2 videos, 6 frames; unlabelled, so there are no scores" in ended.out
    [file] = trained.glob("evaluate/last_test_data_*/metrics.json")
    found = json.loads(file.read_text())["splits"]["test"]
    assert found["labelled"] is False
    assert found["total"] == {"videos": 2, "frames": 6}
    assert found["terms"].keys() == {"error", "spread"}
    assert (file.parent / "predictions" / "test.npz").is_file()
    assert (file.parent / "view" / "test" / "film_strip.png").is_file()
