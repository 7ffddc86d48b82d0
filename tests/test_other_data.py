"""Scoring a checkpoint on other data, and data without labels, from the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import REPOSITORY, Ended

CONF = ("--config-dir", str(REPOSITORY / "tests" / "conf"))


def scored(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "metrics.json").read_text())["splits"]["test"]


def test_settings_replace_those_of_the_checkpoint(command: Callable[..., Ended], trained: Path) -> None:
    ended = command("evaluate", f"checkpoint={trained}", "data.data_seed=5", "data.test=4", "pictures=0")
    assert ended.code == 0, ended.err
    [folder] = (trained / "evaluate").iterdir()
    other, own = scored(folder), scored(trained)
    assert other["data"]["settings"] == {**own["data"]["settings"], "seed": 5, "test": 4}
    assert other["data"]["fingerprint"] != own["data"]["fingerprint"]
    assert other["videos"] == 4
    assert scored(trained) == own  # the run's own scores stay
    again = command("evaluate", f"checkpoint={trained}", "data.data_seed=5", "data.test=4", "pictures=0")
    assert "evaluated already" in again.out


def test_another_data_set_in_the_same_sizes(command: Callable[..., Ended], trained: Path) -> None:
    ended = command("evaluate", f"checkpoint={trained}", "data=sprites", "data.max_objects=2", "pictures=0")
    assert ended.code == 0, ended.err
    [folder] = (trained / "evaluate").iterdir()
    about = scored(folder)["data"]
    assert about["name"] == "sprites"
    sizes = {key: about["settings"][key] for key in ("frames", "image_size", "test", "max_objects")}
    assert sizes == {"frames": 3, "image_size": 32, "test": 2, "max_objects": 2}


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("data.nonsense=1",), "Unknown key data.nonsense = 1"),
        (("data.test=many",), "data.test = 'many' is wrong"),
        (("data=nowhere",), "data=nowhere: there is no such choice"),
        (("predictions=x.npz", "data.test=3"), "goes with checkpoint"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence(
    command: Callable[..., Ended], trained: Path, words: tuple[str, ...], sentence: str
) -> None:
    Path("x.npz").write_bytes(b"")
    first = () if words[0].startswith("predictions") else (f"checkpoint={trained}",)
    ended = command("evaluate", *first, *words)
    assert ended.code == 2
    assert sentence in ended.err
    assert len(ended.err.splitlines()) == 1


def test_unlabelled_videos_give_losses_and_pictures_and_no_scores(
    train: Callable[..., Ended], the_run: Callable[..., Path]
) -> None:
    ended = train(
        "+data.labelled=false", "trainer.monitor=val/loss", "trainer.monitor_mode=min", "evaluation.pictures=2"
    )
    assert ended.code == 0, ended.err
    assert "test: 2 videos, 6 frames; unlabelled, so there are no scores" in ended.out
    result = scored(the_run())
    assert result["labelled"] is False
    assert set(result["total"]) == {"videos", "frames"}
    assert set(result["terms"]) == {"error", "spread"}
    assert result["objects_present"] == 2.0
    assert (the_run() / "view" / "film_strip.png").is_file()
    curves = (the_run() / "curves.csv").read_text().splitlines()[0].split(",")
    assert "val/loss" in curves
    assert "val/ari_fg" not in curves
    assert (the_run() / "checkpoints" / "best.ckpt").is_file()
