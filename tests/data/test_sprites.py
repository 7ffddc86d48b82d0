"""Sprites: the same numbers give the same videos, labels fit what is seen, and motion is what is drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from apex_lab.base.errors import UserError
from apex_lab.data import Clip, SpritesSource
from apex_lab.data.sprites.__main__ import main
from apex_lab.data.sprites.drawing import COLOURS, GROUND, Sprite, coverage, draw_sprites


def source(**settings: int) -> SpritesSource:
    made = SpritesSource(**{"train": 5, "val": 2, "test": 3, "frames": 8, "image_size": 64, **settings})
    made.open()
    return made


def test_a_video_is_a_function_of_seed_split_and_index() -> None:
    one, same = source().sets["train"], source(train=50, val=7).sets["train"]
    assert torch.equal(one[3]["video"], same[3]["video"])
    others = [source(data_seed=1).sets["train"][3], source().sets["val"][1], one[2]]
    assert not any(torch.equal(one[3]["video"], other["video"]) for other in others)


def test_a_clip_is_a_part_of_its_video() -> None:
    videos = source().sets["test"]
    clip = videos[Clip(2, start=3, frames=4)]
    assert torch.equal(clip["video"], videos[2]["video"][3:7])
    assert torch.equal(clip["segmentation"], videos[2]["segmentation"][3:7])
    assert (clip["index"], clip["name"]) == (2, "test_00002")
    with pytest.raises(IndexError):
        videos[Clip(0, start=6, frames=4)]


def test_labels_are_where_colours_are() -> None:
    videos = source(train=20).sets["train"]
    for index in range(20):
        item = videos[index]
        image, labels = item["video"].permute(0, 2, 3, 1).numpy().astype(int), item["segmentation"].numpy()
        sprites = draw_sprites(0, "train", index, (2, 4))
        assert set(np.unique(labels)) <= set(range(len(sprites) + 1))
        for number, sprite in enumerate(sprites, start=1):
            inside = image[labels == number]
            if len(inside) > 30:
                exact = (inside == np.array(COLOURS[sprite.colour])).all(axis=1).mean()
                assert exact > 0.4  # all but the rim
        assert ((image[labels == 0] == np.array(GROUND)).all(axis=1)).mean() > 0.8


def test_the_area_of_a_disc_and_where_it_moves() -> None:
    disc = Sprite(shape=0, colour=0, radius=0.2, angle=0.0, start=(0.3, 0.5), velocity=(0.1, 0.0))
    centres = [disc.centre(t) for t in range(8)]
    expected = [0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.7, 0.6]  # thrown back at 1 - radius
    assert [x for x, _ in centres] == pytest.approx(expected)
    covered = coverage(disc, 0, 64)
    assert covered.sum() / 64**2 == pytest.approx(np.pi * 0.2**2, rel=0.03)
    assert (covered * (np.arange(64) + 0.5)).sum() / covered.sum() / 64 == pytest.approx(0.3, abs=0.004)


def test_occlusion_is_what_nearer_sprites_cover() -> None:
    videos = source(train=30).sets["train"]
    for index in range(30):
        about, labels = videos.metadata(index), videos[index]["segmentation"].numpy()
        sprites = draw_sprites(0, "train", index, (2, 4))
        assert about.occlusion is not None
        for column, sprite in enumerate(sprites):
            alone = (coverage(sprite, 0, 64) >= 0.5).sum()
            assert about.occlusion[0, column] == pytest.approx(1 - (labels[0] == column + 1).sum() / alone)


def test_stored_videos_are_those_that_are_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drawn = source()
    stored = SpritesSource(
        **{**drawn.settings, "stored": True, "root": str(tmp_path), "sim_workers": 1},  # a process without PyTorch
    )
    stored.prepare()
    stored.open()
    assert stored.fingerprint == drawn.fingerprint
    for split, videos in stored.sets.items():
        assert len(videos) == len(drawn.sets[split])
        for index in range(len(videos)):
            one, other = videos[index], drawn.sets[split][index]
            assert torch.equal(one["video"], other["video"])
            assert torch.equal(one["segmentation"], other["segmentation"])
            assert one["name"] == other["name"]
            about, same = videos.metadata(index), drawn.sets[split].metadata(index)
            assert about is not None
            assert same is not None
            assert np.array_equal(about.occlusion, same.occlusion)
    clip = Clip(2, start=3, frames=4)
    assert torch.equal(stored.sets["test"][clip]["video"], drawn.sets["test"][clip]["video"])
    assert stored.describe()["folder"] == str(stored.folder)
    # damage is found and repaired
    array = stored.folder / "val" / "rgb.npy"
    whole = array.read_bytes()
    array.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(UserError, match=r"repair it with python -m apex_lab.data.sprites verify .* --repair"):
        stored.prepare()
    assert main(["verify", str(stored.folder)]) == 1
    assert main(["verify", str(stored.folder), "--repair", "--workers", "1"]) == 0
    assert array.read_bytes() == whole
    assert main(["verify", str(stored.folder)]) == 0
    assert main(["verify", str(tmp_path)]) == 1


def test_without_stored_nothing_is_written(tmp_path: Path) -> None:
    made = SpritesSource(train=2, val=1, test=1, generate=False, root=str(tmp_path))
    made.refuse_missing()
    made.prepare()
    made.open()
    assert made.sets["train"][0]["video"].shape == (20, 3, 128, 128)
    assert list(tmp_path.iterdir()) == []
    stored = SpritesSource(stored=True, generate=False, root=str(tmp_path))
    for missed in (stored.refuse_missing, stored.prepare):
        with pytest.raises(UserError, match=r"no finished sprites data at .*: set data.generate=true or run"):
            missed()


def test_the_fingerprint_changes_with_every_setting() -> None:
    base = source().fingerprint
    assert source().fingerprint == base
    for key, value in {"data_seed": 1, "train": 6, "frames": 9, "image_size": 32, "max_objects": 3}.items():
        assert source(**{key: value}).fingerprint != base


def test_impossible_counts_are_refused() -> None:
    with pytest.raises(UserError, match="min_objects = 5 is above max_objects = 4"):
        source(min_objects=5)
