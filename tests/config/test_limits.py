"""What the machine cannot do is refused before it is tried; what never ends is ended."""

from __future__ import annotations

import itertools
import time

import pytest
from torch import nn

from apex_lab.base.errors import UserError
from apex_lab.config import limits


class Tree(nn.Module):
    """Twice as many parts with each level."""

    def __init__(self, depth: int) -> None:
        super().__init__()
        if depth:
            self.left, self.right = Tree(depth - 1), Tree(depth - 1)


def test_a_model_of_endless_parts() -> None:
    with pytest.raises(UserError, match="it has more than 20,000 parts"), limits.bounded():
        Tree(100)
    Tree(3)  # the bound is gone


def test_weights_are_counted_before_memory_is_taken_for_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "memory", lambda: 10**6)
    with limits.bounded(copies=1):
        nn.Linear(400, 500)
    told = "its weights take more than the 0 GB of this machine in training"
    with pytest.raises(UserError, match=told), limits.bounded():
        nn.Linear(400, 500)


def test_building_that_does_not_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SECONDS", 0.2)
    told = r"building it takes more than 0\.2 seconds"
    with pytest.raises(UserError, match=told), limits.bounded(), limits.bounded():
        sum(0 for _ in itertools.count())
    end = time.process_time() + 0.3
    while time.process_time() < end:  # the clock has stopped
        pass


def test_batches_and_lists(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "memory", lambda: 10**9)
    config = {
        "data": {"frames": 10, "image_size": 100, "train": 1000},
        "clips": {"batch_size": 4},
        "evaluation": {"batch_size": 4, "chunk": None},
    }
    limits.refuse_large_batches(config, None)
    few = {"frames": 10**4, "image_size": 100, "train": 2, "val": 2, "test": 1}
    limits.refuse_large_videos(few, 10**9, 10, "batch_size")  # there are two videos at most
    with pytest.raises(UserError, match=r"^batch_size = 1000000000, data.frames = 10000, data.*: 30,000 "):
        limits.refuse_large_videos({**few, "test": 3}, 10**9, None, "batch_size")
    for part, change, clip, told in (
        (
            "data",
            {"frames": 10**6},
            3,
            "evaluation.batch_size = 4, data.frames = 1000000, data.image_size = 100",
        ),
        ("data", {"frames": 10**6}, None, "clips.batch_size = 4, data.frames = 1000000"),
        ("clips", {"batch_size": 10**4}, None, "a batch of 100,000 frames would take 12 GB, and this machine has 1 GB"),
        ("data", {"train": 10**9}, None, "data.train = 1000000000: a list of 1,000,000,000 videos would take 64 GB"),
    ):
        with pytest.raises(UserError, match=told):
            limits.refuse_large_batches({**config, part: {**config[part], **change}}, clip)
