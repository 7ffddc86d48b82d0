"""What commands read that are killed, and what they leave when nothing disturbs them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fakes.own_videos import write_video
from tests.kills import works
from tests.kills.processes import Measured, Running
from tests.kills.works import WORKS


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What commands read: a trained model, a video, a folder of videos."""
    folder = tmp_path_factory.mktemp("inputs")
    ended = Running(works.TRAIN, (*works.TINY, "trainer.max_steps=4", "data.test=6"), folder).end()
    assert ended.code == 0, ended.said
    [run] = folder.glob("outputs/*/seed_0")
    shutil.copy(run / "checkpoints" / "last.ckpt", folder / "last.ckpt")
    write_video(folder / "clip.mp4", 0, 14)
    (folder / "videos").mkdir()
    for number in range(10):
        write_video(folder / "videos" / f"{number}.avi", number, 14)
    return folder


@pytest.fixture(scope="session")
def unbroken(
    inputs: Path, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], tuple[dict[str, object], Measured]]:
    """What a command leaves that nothing disturbs, and what it takes."""
    found: dict[str, tuple[dict[str, object], Measured]] = {}

    def of(name: str) -> tuple[dict[str, object], Measured]:
        if name not in found:
            folder = tmp_path_factory.mktemp("unbroken")
            words = [word.replace("{inputs}", str(inputs)) for word in WORKS[name].words]
            ended = Running(WORKS[name].entry, words, folder, variables=WORKS[name].variables).end(WORKS[name].workers)
            assert ended.code == 0, ended.said
            found[name] = WORKS[name].results(folder), ended.measured
            assert found[name][0]
            assert not works.not_whole(folder)  # the reader itself accepts what is whole
        return found[name]

    return of
