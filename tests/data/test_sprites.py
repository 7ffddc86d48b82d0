"""Sprites: the same numbers give the same videos, labels fit what is seen, and motion is what is drawn."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from apex_lab.base.errors import UserError
from apex_lab.data import Clip, Sprites, SpritesSource
from apex_lab.data.sprites import COLOURS, GROUND, Sprite, draw_sprites


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
        sprites = draw_sprites(0, "train", index, (1, 4))
        assert set(np.unique(labels)) <= set(range(len(sprites) + 1))
        for number, sprite in enumerate(sprites, start=1):
            inside = image[labels == number]
            if len(inside) > 30:
                exact = (inside == np.array(COLOURS[sprite.colour])).all(axis=1).mean()
                assert exact > 0.4  # all but the rim
        assert ((image[labels == 0] == np.array(GROUND)).all(axis=1)).mean() > 0.8


def test_the_area_of_a_disc_and_where_it_moves() -> None:
    disc = Sprite(shape=0, colour=0, radius=0.2, angle=0.0, start=(0.3, 0.5), velocity=(0.1, 0.0))
    videos = Sprites(0, "train", 1, 8, 64, (1, 1))
    centres = [disc.centre(t) for t in range(8)]
    expected = [0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.7, 0.6]  # thrown back at 1 - radius
    assert [x for x, _ in centres] == pytest.approx(expected)
    covered = videos._coverage(disc, 0)
    assert covered.sum() / 64**2 == pytest.approx(np.pi * 0.2**2, rel=0.03)
    assert (covered * (np.arange(64) + 0.5)).sum() / covered.sum() / 64 == pytest.approx(0.3, abs=0.004)


def test_occlusion_is_what_nearer_sprites_cover() -> None:
    videos = source(train=30).sets["train"]
    for index in range(30):
        about, labels = videos.metadata(index), videos[index]["segmentation"].numpy()
        sprites = draw_sprites(0, "train", index, (1, 4))
        assert about.occlusion is not None
        for column, sprite in enumerate(sprites):
            alone = (videos._coverage(sprite, 0) >= 0.5).sum()
            assert about.occlusion[0, column] == pytest.approx(1 - (labels[0] == column + 1).sum() / alone)


def test_the_fingerprint_changes_with_every_setting() -> None:
    base = source().fingerprint
    assert source().fingerprint == base
    for key, value in {"data_seed": 1, "train": 6, "frames": 9, "image_size": 32, "max_objects": 3}.items():
        assert source(**{key: value}).fingerprint != base


def test_impossible_counts_are_refused() -> None:
    with pytest.raises(UserError, match="min_objects = 5 is above max_objects = 4"):
        source(min_objects=5)
