"""P2D as a source: makes missing data once, finds damage at the start, serves the same batches to a resumed run."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from apex_lab.base.errors import UserError
from apex_lab.config import components
from apex_lab.config.composition import conf_dir
from apex_lab.data import P2DSource, recorded, training_loader, whole_loader
from apex_lab.data import p2d_source as code
from sims.p2d.settings import Settings
from sims.p2d.store import fingerprint
from tests.fakes.p2d_tools import FAKE

SIZES = {"train": 5, "val": 3, "test": 2, "frames": 3, "image_size": 16, "workers": 0}


@pytest.fixture(autouse=True)
def fake(monkeypatch: pytest.MonkeyPatch) -> None:
    make = code.generate
    monkeypatch.setattr(
        code, "generate", lambda root, settings, workers: make(root, settings, workers=1, simulator=FAKE, shown=False)
    )


def source(root: Path, **changes: Any) -> P2DSource:
    return P2DSource(str(root), **{**SIZES, **changes})


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture
def ready(made: Path) -> P2DSource:
    data = source(made)
    data.prepare()
    data.open()
    return data


def test_missing_data_are_made_where_their_name_says(ready: P2DSource, made: Path):
    assert ready.folder.parent == made
    assert ready.folder.name.startswith("p2d_16px_3f_")
    assert [len(ready.sets[split]) for split in ("train", "val", "test")] == [5, 3, 2]


def test_other_data_have_another_folder(tmp_path: Path):
    changes: list[dict[str, Any]] = [
        {},
        {"data_seed": 1},
        {"train": 6},
        {"simulation": {"max_objects": 2}},
        {"simulation": {"aim": 1}},
    ]
    assert len({source(tmp_path, **change).folder for change in changes}) == len(changes)


def test_what_is_not_in_the_data_does_not_change_the_folder(tmp_path: Path):
    changes: list[dict[str, Any]] = [
        {},
        {"workers": 3},
        {"sim_workers": 7},
        {"generate": False},
        {"verify": "never"},
        {"simulation": {"max_objects": 3}},
    ]
    assert len({source(tmp_path, **change).folder for change in changes}) == 1


def test_a_resumed_run_sees_the_batches_of_an_unbroken_one(ready: P2DSource):
    unbroken = [batch["video"] for batch in training_loader(ready, 2, 0, 0, 9)]
    loader = training_loader(ready, 2, 0, 4, 9)
    assert len(loader) == 5
    for resumed, expected in zip(loader, unbroken[4:], strict=True):
        torch.testing.assert_close(resumed["video"], expected)
        assert resumed["video"].shape == (2, 3, 3, 16, 16)


def test_the_order_depends_on_the_seed_of_the_run(ready: P2DSource):
    def order(seed: int) -> list[int]:
        return [int(index) for batch in training_loader(ready, 2, seed, 0, 10) for index in batch["index"]]

    assert order(0) == order(0)
    assert order(0) != order(1)


def test_starting_a_loader_leaves_the_random_numbers_of_the_training_alone(ready: P2DSource):
    before = torch.get_rng_state()
    next(iter(training_loader(ready, 2, 0, 0, 2)))
    next(iter(whole_loader(ready.sets["val"], 2)))
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("workers", [0, 2])
def test_clips_are_parts_of_their_videos(made: Path, ready: P2DSource, workers: int):
    data = source(made, workers=workers)
    data.open()
    for batch in training_loader(data, 2, 0, 0, 4, lambda step: 1 + step % 2):
        for index, clip in zip(batch["index"], batch["video"], strict=True):
            whole = ready.sets["train"][int(index)]["video"]
            assert any(torch.equal(clip, whole[i : i + len(clip)]) for i in range(len(whole) - len(clip) + 1))


def test_evaluation_takes_all_videos_in_order(ready: P2DSource):
    def indices(split: str, count: int | None = None, **rank: int) -> list[list[int]]:
        return [batch["index"].tolist() for batch in whole_loader(ready.sets[split], 2, count, **rank)]

    assert indices("val") == [[0, 1], [2]]
    assert indices("test") == [[0, 1]]
    assert indices("train", 3) == [[0, 1], [2]]
    assert [indices("train", rank=rank, ranks=2) for rank in range(2)] == [[[0, 2], [4]], [[1, 3]]]
    names = [name for batch in whole_loader(ready.sets["val"], 2) for name in batch["name"]]
    assert names == ["val_00000", "val_00001", "val_00002"]


def test_what_the_record_of_a_run_keeps(ready: P2DSource):
    described = json.loads(json.dumps(ready.describe()))
    assert described["name"] == "p2d"
    assert described["settings"]["train"] == 5
    assert described["folder"] == str(ready.folder)
    assert described["fingerprint"] == ready.fingerprint
    assert ready.folder.name.endswith(fingerprint(Settings(**described["settings"]))[:8])
    assert ready.sets["train"].median().shape == (3, 16, 16)


def test_missing_data_are_refused_when_they_may_not_be_made(tmp_path: Path):
    data = source(tmp_path, generate=False, simulation={"max_objects": 2})
    with pytest.raises(UserError) as caught:
        data.prepare()
    sentence = str(caught.value)
    assert sentence.startswith(
        f"no finished P2D data at {data.folder}: set data.generate=true or run python -m sims.p2d"
    )
    for word in ("train=5", "frames=3", "image_size=16", "max_objects=2"):
        assert word in sentence
    assert not data.folder.exists()


def test_without_the_simulator_one_sentence_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from sims.p2d.generate import generate

    monkeypatch.setattr(
        code, "generate", lambda root, settings, workers: generate(root, settings, simulator="pybullet_is_not_here")
    )
    with pytest.raises(UserError, match=r"pybullet_is_not_here' is not installed: install it \(for pybullet, run"):
        source(tmp_path).prepare()


def flip(data: P2DSource) -> None:
    with open(data.folder / "train" / "rgb.npy", "r+b") as file:
        file.seek(-1, os.SEEK_END)
        byte = file.read(1)[0]
        file.seek(-1, os.SEEK_END)
        file.write(bytes([byte ^ 1]))


@pytest.mark.parametrize("verify", ["changed", "always"])
def test_a_flipped_bit_is_found_at_the_start(tmp_path: Path, verify: str):
    data = source(tmp_path, verify=verify)
    data.prepare()
    flip(data)
    for _ in range(2):
        with pytest.raises(
            UserError,
            match=r"is damaged \(trajectory train/4: bytes do not match the checksum\): repair it with python -m",
        ):
            data.prepare()


def test_the_full_check_is_not_done_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    data = source(tmp_path)
    data.prepare()
    calls: list[Path] = []
    check = recorded.verify
    monkeypatch.setattr(recorded, "verify", lambda root, manifest: calls.append(root) or check(root, manifest))
    data.prepare()
    assert calls == []
    os.utime(data.folder / "val" / "depth.npy")
    data.prepare()
    data.prepare()
    assert calls == [data.folder]
    always = source(tmp_path, verify="always")
    always.prepare()
    always.prepare()
    assert len(calls) == 3


def test_never_means_never(tmp_path: Path):
    data = source(tmp_path)
    data.prepare()
    flip(data)
    source(tmp_path, verify="never").prepare()
    with pytest.raises(UserError):  # the damage was there to be found
        source(tmp_path, verify="always").prepare()


@pytest.mark.parametrize(
    ("simulation", "sentence"),
    [
        ({"max_object": 2}, "unknown setting 'max_object': did you mean max_objects"),
        ({"frames": 2}, "simulation.frames is not a key: set data.frames instead"),
        ({"seed": 2}, "simulation.seed is not a key: set data.data_seed instead"),
        ({"aim": 2.0}, "setting aim=2.0 is not possible: input should be less than or equal to 1"),
        ({"min_objects": 4}, "settings do not fit together: min_objects 4 must not exceed max_objects 3"),
        ({"camera": {"fog": 1}}, "unknown setting 'camera.fog'"),
    ],
)
def test_impossible_simulations_are_refused_at_once(tmp_path: Path, simulation: dict[str, Any], sentence: str):
    with pytest.raises(UserError) as caught:
        source(tmp_path, simulation=simulation)
    assert str(caught.value).startswith(sentence)


def shipped() -> dict[str, Any]:
    node = yaml.safe_load((conf_dir() / "data" / "p2d.yaml").read_text())
    return {**node, "root": "data"}


def test_the_shipped_configuration_is_the_default_data_set():
    components.check(shipped(), "data")
    built = components.build(shipped(), "data")
    assert built.settings == Settings()
    assert built.settings.train + built.settings.val + built.settings.test == 2400


@pytest.mark.parametrize(
    "change",
    [{"frames": "8"}, {"train": 0}, {"batchsize": 2}, {"verify": "sometimes"}, {"generate": 1}, {"image_size": 8}],
)
def test_wrong_values_in_a_configuration_are_refused(change: dict[str, Any]):
    with pytest.raises(UserError, match=f"data.{next(iter(change))}"):
        components.check({**shipped(), **change}, "data")
