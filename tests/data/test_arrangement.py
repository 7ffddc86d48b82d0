"""Clips of the arrangement task's table."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("pybullet")

from apex_lab.base.errors import UserError
from apex_lab.data import ArrangementSource
from apex_lab.inference.sizes import fitted
from sims.arrangement.scenario import draw
from sims.arrangement_clips.clip import SPLITS, sample, shrunk, shrunk_labels
from sims.arrangement_clips.settings import Settings
from sims.assets import object_models
from sims.poses import moved


def test_objects_slide_apart_from_each_other_inside_the_workspace() -> None:
    settings = Settings(frames=8)
    still = 0
    for index in range(20):
        clip = sample(settings, "train", index)
        assert 2 <= len(clip.names) == len(set(clip.names)) <= 4
        steps = np.linalg.norm(np.diff(clip.poses[:, :, :2], axis=0), axis=2)
        assert steps.max() <= settings.step_m + 1e-9
        assert np.ptp(steps, axis=0).max() < 1e-9  # steadily
        still += not steps.any()
        low, high = np.transpose([settings.workspace_x, settings.workspace_y])
        assert (clip.poses[..., :2] >= low).all()
        assert (clip.poses[..., :2] <= high).all()
        for frame in clip.poses:
            points = [moved(model.touching, pose) for model, pose in zip(object_models(clip.names), frame, strict=True)]
            assert all(cloud[:, 2].min() > -1e-3 for cloud in points)
            for one in range(len(points)):
                for other in range(one):
                    gaps = np.linalg.norm(points[one][:, None, :2] - points[other][None, :, :2], axis=2)
                    assert gaps.min() > 0.02
    assert still <= 1  # where no free way was found


def test_a_clip_is_a_function_of_seed_split_and_index() -> None:
    settings = Settings(frames=3)
    one = sample(settings, "train", 4)
    again = sample(settings, "train", 4)
    assert one.names == again.names
    assert (one.poses == again.poses).all()
    others = [sample(settings, split, index).poses[0, 0] for split in SPLITS for index in (3, 4)]
    others.append(sample(settings.model_copy(update={"seed": 1}), "train", 4).poses[0, 0])
    scenario = draw(0, 2, 4, settings.task)
    others += [place.pose for place in (*scenario.goal, *scenario.current)]
    assert len({tuple(pose[:2].round(9)) for pose in others}) == len(others)


def test_images_are_scaled_as_the_task_s_are_for_a_model() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (128, 128, 3), dtype=np.uint8)
    ours = shrunk(rgb, 64).astype(float)
    video = torch.from_numpy(rgb).permute(2, 0, 1)[None, None] / 255
    theirs = fitted(video, (64, 64))[0, 0].permute(1, 2, 0).numpy() * 255
    assert np.abs(ours - theirs).max() <= 1.0
    labels = np.zeros((8, 8), dtype=np.uint8)
    labels[:, 4:], labels[0, 0] = 5, 3
    assert shrunk_labels(labels, 4).tolist() == [[0, 0, 5, 5]] * 4


def test_a_tiny_data_set(tmp_path: Path) -> None:
    source = ArrangementSource(str(tmp_path), train=2, val=1, test=1, frames=2, image_size=32, sim_workers=1)
    source.prepare()
    source.open()
    item = source.sets["train"][0]
    clip = sample(source.settings, "train", 0)
    assert item["video"].shape == (2, 3, 32, 32)
    assert set(item["segmentation"].unique().tolist()) <= {0, *range(2, 2 + len(clip.names))}
    metadata = source.sets["train"].metadata(0)
    assert metadata is not None
    assert (metadata.labels.tolist(), tuple(metadata.classes)) == (list(range(2, 2 + len(clip.names))), clip.names)
    assert len({item["name"] for split in source.sets.values() for item in (split[0],)}) == 3
    assert source.describe()["settings"]["frames"] == 2
    assert source.folder.name.startswith("arrangement_32px_2f_")


def test_impossible_settings_are_told() -> None:
    for more, told in {
        "frames": "simulation.frames is not a key: set data.frames instead",
        "max_object": "Unknown key simulation.max_object = 3; did you mean 'max_objects'?",
    }.items():
        with pytest.raises(UserError, match=told.replace("?", r"\?")):
            ArrangementSource("x", simulation={more: 3})
    with pytest.raises(UserError, match="max_objects 5 needs as many classes in objects, which has 4"):
        ArrangementSource("x", simulation={"max_objects": 5})
    assert dataclasses.is_dataclass(sample(Settings(frames=1, moving=0.0), "val", 0))
