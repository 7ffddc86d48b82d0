"""`data=sketchy`: which clips a prepared recording gives, and what a run is told when it is not there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hydra import compose

from apex_lab.base.errors import UserError
from apex_lab.config.composition import composing, plain
from apex_lab.data import Clip, Sketchy, SketchySource, training_loader, whole_loader
from apex_lab.data.sketchy.command import main
from apex_lab.data.sketchy.recording import recording_folder
from tests.conftest import Ended
from tests.data.sketchy.episodes import episode_name, level, write_episode

LENGTHS = {0: 9, 1: 4, 2: 7, **dict.fromkeys(range(3, 10), 3)}
"""Number of an episode -> timesteps: 0 validates, 1 tests, the others train."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sketchy")
    for number, timesteps in LENGTHS.items():
        write_episode(folder / "files", number, timesteps)
    main([str(folder / "files"), "--root", str(folder), "--image-size", "32", "--windows", "full,c3", "--workers", "2"])
    return folder


def source(root: Path, **changes: Any) -> SketchySource:
    return SketchySource(**{"root": str(root), "image_size": 32, "frames": 3, "workers": 0, **changes})


def opened(root: Path, **changes: Any) -> dict[str, Sketchy]:
    made = source(root, **changes)
    made.prepare()
    made.open()
    return made.sets


def grey(video: torch.Tensor) -> list[int]:
    """The grey level of each frame."""
    return video.float().mean((1, 2, 3)).round().int().tolist()


def test_clips_are_of_one_view_of_one_episode(root: Path) -> None:
    for split, videos in opened(root).items():
        assert not videos.labelled
        assert not SketchySource.labelled
        assert videos.image_size == (32, 32)
        for index in range(len(videos)):
            item, about = videos[index], videos.meta(index)
            assert item.keys() == {"video", "index", "name"}
            assert item["video"].shape == (3, 3, 32, 32)
            assert item["video"].dtype == torch.uint8
            number = next(n for n in LENGTHS if episode_name(n) == about["episode"])
            assert {0: "val", 1: "test"}.get(number, "train") == split
            camera = ("fl", "fr").index(about["camera"])
            expected = np.array([level(t, number, camera) for t in about["timesteps"].tolist()])
            assert np.abs(expected - grey(item["video"])).max() <= 1  # JPEG
            assert about["timesteps"].tolist() == list(range(about["timesteps"][0], about["timesteps"][0] + 3))


def test_training_has_every_start_and_validation_none_that_overlaps(root: Path) -> None:
    sets = opened(root)
    starts = {
        split: sorted((about["episode"], int(about["timesteps"][0])) for about in map(videos.meta, range(len(videos))))
        for split, videos in sets.items()
    }
    views = 4
    assert starts["val"] == sorted((episode_name(0), start) for start in (0, 3, 6) for _ in range(views))
    assert starts["test"] == [(episode_name(1), 0)] * views
    train = [(episode_name(2), start) for start in range(5)] + [(episode_name(n), 0) for n in range(3, 10)]
    assert starts["train"] == sorted(train * views)


def test_names_tell_episode_view_and_start_and_the_first_clips_differ_most(root: Path) -> None:
    sets = opened(root)
    names = [videos.name(index) for videos in sets.values() for index in range(len(videos))]
    assert len(set(names)) == len(names)
    # numbers of episodes run on through train, val and test
    assert [sets["val"].name(index) for index in range(5)] == [
        *("ep000008_fl_full_t000", "ep000008_fr_full_t000", "ep000008_fl_c3_t000", "ep000008_fr_c3_t000"),
        "ep000008_fl_full_t003",
    ]
    assert [sets["train"].name(index)[:8] for index in range(8)] == [f"ep{number:06d}" for number in range(8)]


def test_a_stride_leaves_timesteps_out(root: Path) -> None:
    sets = opened(root, stride=2)
    timesteps = [sets["val"].meta(index)["timesteps"].tolist() for index in range(len(sets["val"]))]
    assert timesteps == [[0, 2, 4]] * 4  # of 9: the next clip would be 6, 8, 10
    assert sorted(sets["train"].meta(i)["timesteps"].tolist() for i in range(len(sets["train"]))) == sorted(
        [[start, start + 2, start + 4] for start in range(3)] * 4
    )
    item = sets["val"][0]
    assert grey(item["video"]) == pytest.approx([level(t) for t in (0, 2, 4)], abs=1)
    assert sets["train"].short == 7
    assert sets["test"].short == 1


def test_a_part_of_a_clip(root: Path) -> None:
    for stride in (1, 2):
        videos = opened(root, stride=stride)["val"]
        assert torch.equal(videos[Clip(0, 1, 2)]["video"], videos[0]["video"][1:])
        assert torch.equal(videos[Clip(0, 1, 1)]["video"], videos[0]["video"][1:2])
    with pytest.raises(IndexError, match="frames 2 to 3 of a clip that has 3"):
        videos[Clip(0, 2, 2)]


def test_windows_and_limits_choose_among_what_is_prepared(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert [len(videos) for videos in opened(root, windows=["full"]).values()] == [24, 6, 2]
    assert [len(videos) for videos in opened(root, train=3, val=0).values()] == [28, 0, 4]
    with pytest.raises(UserError, match=r"was prepared without the window 'c0': choose of full, c3 in data\.windows"):
        opened(root, windows=["full", "c0"])
    with pytest.raises(UserError, match=r"has no training clip of 8 frames: lower data\.frames"):
        opened(root, frames=8)


def test_the_fingerprint_tells_clips_apart(root: Path) -> None:
    changes: list[dict[str, Any]] = [{}, {"frames": 2}, {"stride": 2}, {"windows": ["full"]}, {"train": 3}]
    assert len({source(root, **change).fingerprint for change in changes}) == len(changes)
    assert source(root).fingerprint == source(root, workers=2).fingerprint
    about = source(root).describe()
    assert about["name"] == "sketchy"
    assert about["prepared"]["train_episodes"] == 8


@pytest.mark.parametrize("workers", [0, 1])
def test_loaders(root: Path, workers: int) -> None:
    made = source(root, workers=workers)
    made.prepare()
    made.open()
    batches = list(training_loader(made, batch_size=4, seed=0, start=0, stop=3, frames=lambda step: 2))
    assert [batch["video"].shape for batch in batches] == [(4, 2, 3, 32, 32)] * 3
    assert sum(len(batch["name"]) for batch in whole_loader(made.sets["val"], 5)) == 12


def test_what_is_missing_or_unfinished_is_told_with_the_command(root: Path, tmp_path: Path) -> None:
    command = "python -m apex_lab.data.sketchy FOLDER --root .* --name demos --image-size 32"
    with pytest.raises(UserError, match=f"sketchy_demos_32px is not there: prepare it with {command}"):
        source(tmp_path).prepare()
    folder = recording_folder(tmp_path, "demos", 32)
    folder.mkdir()
    (folder / "timesteps.jsonl").write_bytes((recording_folder(root, "demos", 32) / "timesteps.jsonl").read_bytes())
    with pytest.raises(UserError, match="is not finished: prepare it with"):
        source(tmp_path).prepare()


def test_damage_is_found_before_a_run(root: Path) -> None:
    made = source(root)
    made.prepare()
    array = recording_folder(root, "demos", 32) / "val" / "fl_full.npy"
    whole = array.read_bytes()
    array.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    try:
        sentence = "is damaged.*repair it with python -m apex_lab.data.sketchy FOLDER .*--repair"
        with pytest.raises(UserError, match=sentence):
            made.prepare()
    finally:
        array.write_bytes(whole)
    made.prepare()


PAPER = {
    "apex": (4, None, 40_000, None),
    "scalor": (4, None, 40_000, None),
    "op3": (4, 5, 40_000, 8),
    "slot_attention": (16, 1, 250_000, 8),
    "space": (16, 1, 100_000, None),
    "gswm": (4, [2, 4, 6, 8, 10], 50_000, None),  # 10,000 of them to warm up
}
"""Model -> batch, frames of a clip, steps, slots; None: whole sequences, or no slots."""


@pytest.mark.parametrize("model", list(PAPER))
def test_recipes_at_the_papers_scale(model: str) -> None:
    batch, frames, steps, slots = PAPER[model]
    words = [f"model={model}", "data=sketchy", "scale=paper"]
    with composing(words):
        config = plain(compose("train", overrides=words))
        on_p2d = plain(compose("train", overrides=[f"model={model}", "scale=paper"]))
    data, clips = config["data"], config["clips"]
    assert (data["frames"], data["image_size"]) == (10, 128)
    assert clips["batch_size"] == batch
    assert (clips["frames"]["values"] if isinstance(clips["frames"], dict) else clips["frames"]) == frames
    assert config["trainer"]["max_steps"] == steps
    assert config["model"].get("slots") == slots
    if model == "scalor":
        assert set(config["loss"].values()) == {1 / data["frames"]}
    # nothing else differs from P2D
    changed = {"gswm": ["clips"], "scalor": ["loss"], "op3": ["model"], "slot_attention": ["model"]}.get(model, [])
    for part in ("model", "optimizer", "lr_scale", "schedule", "loss", "clips"):
        assert (config[part] != on_p2d[part]) == (part in changed)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["apex", "slot_attention"])
def test_training_on_generated_episodes(root: Path, tmp_path: Path, model: str, command: Callable[..., Ended]) -> None:
    """Losses and pictures, and no score, since there are no labels."""
    words = (f"model={model}", "data=sketchy", "scale=smoke", f"paths.data={root}", f"paths.outputs={tmp_path}")
    ended = command("train", *words)
    assert ended.code == 0, ended.err
    assert "unlabelled, so there are no scores" in ended.out
    curves = next(tmp_path.rglob("curves.csv")).read_text().splitlines()
    assert "val/loss" in curves[0]
    assert "val/objects_present" in curves[0]
    assert len(list(tmp_path.rglob("best.ckpt"))) == 1
    assert "ari" not in curves[0]
    assert list(tmp_path.rglob("*.png"))
