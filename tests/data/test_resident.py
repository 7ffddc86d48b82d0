"""Videos that lie on the device give the batches that a loader gives."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from apex_lab.data import Clip, ClipSampler, VideoSet, VideoSource
from apex_lab.data.clips import Starts
from apex_lab.data.loaders import training_loader
from apex_lab.data.loading import options
from apex_lab.data.resident import Resident, size, worth_it
from tests.conftest import TINY, train_in
from tests.test_train import equal


class Numbered(VideoSet):
    """Videos of several lengths and two cameras, whose pixels tell video, camera and frame."""

    views = 2

    def __len__(self) -> int:
        return 5

    def length(self, video: int) -> int:
        return 4 + video % 3

    @property
    def image_size(self) -> tuple[int, int]:
        return 2, 3

    def name(self, video: int) -> str:
        return f"video {video}"

    def read(self, clip: Clip) -> dict[str, Tensor]:
        numbers = torch.arange(self.length(clip.video), dtype=torch.uint8) + 20 * clip.video + 10 * clip.view
        whole = numbers[:, None, None, None].expand(-1, 3, 2, 3)
        end = None if clip.frames is None else clip.start + clip.frames
        video = whole[clip.start : end].contiguous()
        return {"video": video, "segmentation": video[:, 0]}


class Unreadable(Numbered):
    def read(self, clip: Clip) -> dict[str, Tensor]:
        raise RuntimeError("unreadable")


class Source(VideoSource):
    """Nothing to prepare."""

    sets: Mapping[str, VideoSet] = {"train": Numbered()}
    fingerprint = ""

    def prepare(self) -> None: ...

    def open(self) -> None: ...

    def describe(self) -> dict[str, Any]:
        return {}


@pytest.mark.parametrize("starts", ["random", "disjoint"])
@pytest.mark.parametrize("frames", [lambda step: 1 + step % 4, lambda step: 3])
def test_batches_are_those_of_a_loader(starts: Starts, frames: Callable[[int], int]) -> None:
    of_a_loader = training_loader(Source(), 4, 7, 3, 12, frames, 1, 2, starts)
    batches = of_a_loader.batch_sampler
    assert isinstance(batches, ClipSampler)
    kept = Resident(Numbered(), batches, torch.device("cpu"))
    assert len(kept) == len(of_a_loader) == 9
    for _ in range(2):
        for expected, found in zip(of_a_loader, kept, strict=True):
            assert found.keys() == expected.keys() - {"segmentation"}
            assert torch.equal(found["video"], expected["video"])
            assert found["video"].dtype == torch.uint8
            assert torch.equal(found["index"], expected["index"])
            assert found["name"] == expected["name"]


def test_processes_that_read_them_end_with_the_reading() -> None:
    batches = training_loader(Source(), 4, 7, 3, 12, lambda step: 3).batch_sampler
    assert isinstance(batches, ClipSampler)
    before = set(multiprocessing.active_children())
    kept = Resident(Numbered(), batches, torch.device("cpu"), **options(2))
    assert set(multiprocessing.active_children()) == before
    for expected, found in zip(Resident(Numbered(), batches, torch.device("cpu")), kept, strict=True):
        assert torch.equal(found["video"], expected["video"])
    with pytest.raises(RuntimeError, match="unreadable"):
        Resident(Unreadable(), batches, torch.device("cpu"), **options(2))
    assert set(multiprocessing.active_children()) == before


def test_they_lie_on_a_gpu_where_they_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    videos, gpu = Numbered(), torch.device("cuda")
    assert size(videos) == (4 + 5 + 6 + 4 + 5) * 2 * 3 * 2 * 3
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (4 * size(videos), 10**9))
    many, few = (ClipSampler([4] * 5, 2, 0, 0, stop, lambda step: 2) for stop in (3, 2))
    assert worth_it(videos, many, gpu, 0.25)
    assert not worth_it(videos, many, gpu, 0.24)
    assert not worth_it(videos, few, gpu, 1.0)
    assert not worth_it(videos, many, torch.device("cpu"), 1.0)


def test_a_run_on_them_is_that_of_a_loader(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Through Lightning, with validation and a stop on the way."""
    words = (*TINY, "trainer=cpu", "trainer.max_steps=7", "trainer.validation_interval=3")
    train_in(tmp_path, *words)
    monkeypatch.setattr("apex_lab.data.loaders.worth_it", lambda *_: True)
    monkeypatch.setattr(DataLoader, "__init__", _only_whole(DataLoader.__init__))
    train_in(tmp_path, *words, "paths.outputs=kept", "trainer.max_minutes=1e-6")
    train_in(tmp_path, *words, "paths.outputs=kept")
    equal(*(next((tmp_path / name).glob("*/seed_0")) for name in ("outputs", "kept")))


def _only_whole(real: Callable[..., None]) -> Callable[..., None]:
    def made(loader: Any, *args: Any, **kwargs: Any) -> None:
        assert "batch_sampler" not in kwargs, "clips are loaded step by step"
        real(loader, *args, **kwargs)

    return made


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_on_a_gpu() -> None:
    args = (Source(), 4, 7, 0, 8, lambda step: 3)
    there = training_loader(*args, device=torch.device("cuda"), share=0.25)
    assert isinstance(there, Resident)
    for expected, found in zip(training_loader(*args), there, strict=True):
        assert found["video"].device.type == "cuda"
        assert torch.equal(found["video"].cpu(), expected["video"])
