"""`python -m apex_lab.compare`."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from tests.conftest import REPOSITORY, Ended

EXAMPLE = REPOSITORY / "examples" / "pushing.mp4"


def test_models_on_the_clips_of_the_first_one_s_data(
    command: Callable[..., Ended], trained: Path, tmp_path: Path
) -> None:
    # the shipped weights know another size than the data's
    ended = command("compare", f"checkpoints=[{trained},apex-p2d-cpu]", "trust=true", "clips=2", "folder=cmp")
    assert (ended.code, ended.err) == (0, "")
    assert sorted(path.name for path in (tmp_path / "cmp").iterdir()) == ["test_00000.png", "test_00001.png"]
    assert ended.out.splitlines() == ["cmp/test_00000.png", "cmp/test_00001.png", "2 models on 2 clips"]
    height = Image.open(tmp_path / "cmp" / "test_00000.png").height
    assert height == 12 + 30 + 22 + 6 * 128 + 5 * 4 + 3 * 10 + 12  # input, truth, two rows for each model


def test_models_on_own_videos(command: Callable[..., Ended], tmp_path: Path) -> None:
    words = ("checkpoints=apex-p2d-cpu", f"video={EXAMPLE}", "frames=3", "every=2", "folder=cmp")
    assert command("compare", *words).code == 0
    assert Image.open(tmp_path / "cmp" / "pushing.png").height == 12 + 30 + 22 + 3 * 128 + 2 * 4 + 10 + 12
    ended = command("compare", *words, "start=100")
    assert (ended.code, ended.err) == (1, f"{EXAMPLE} has no frame 100: give a smaller start.\n")


def test_of_many_videos_the_bad_ones_are_named_and_the_others_drawn(
    command: Callable[..., Ended], tmp_path: Path
) -> None:
    (tmp_path / "a.mp4").write_text("no video")
    shutil.copy(EXAMPLE, tmp_path / "b.mp4")
    ended = command("compare", "checkpoints=apex-p2d-cpu", "video=*.mp4", "frames=2", "folder=cmp")
    assert ended.code == 1
    assert ended.out.splitlines() == ["cmp/b.png", "1 model on 1 clip"]
    assert ended.err.splitlines() == [
        "1 of 2 videos were not compared:",
        "  a.mp4 is no video that can be read, or it holds no frame.",
    ]


def test_videos_with_odd_names_are_drawn_under_these(command: Callable[..., Ended], tmp_path: Path) -> None:
    names = ["2026-11-28T10:00:00", "a$b", "a,b=c d", "ok", "${ok}", "\\"]
    (tmp_path / "odd").mkdir()
    for name in [*names, "..dots"]:
        shutil.copy(EXAMPLE, tmp_path / "odd" / f"{name}.mp4")
    words = ("checkpoints=apex-p2d-cpu", "frames=2", "columns=1", "folder=cmp")
    assert command("compare", *words, "video=odd").code == 0
    assert sorted(path.name for path in (tmp_path / "cmp").iterdir()) == sorted(f"{name}.png" for name in names)
    ended = command("compare", *words, "video=odd/..dots.mp4")
    assert (ended.code, ended.out.splitlines()[0]) == (0, "cmp/dots.png")


def test_clips_that_are_not_there_are_refused_before_any_is_drawn(
    command: Callable[..., Ended], tmp_path: Path
) -> None:
    words = ("checkpoints=apex-p2d-cpu", "data=sprites", "data.test=2", "folder=cmp")
    ended = command("compare", *words, "clips=[0,2]")
    assert (ended.code, ended.out, ended.err) == (1, "", "clips holds 2, but there are 2 videos: give 0 to 1.\n")
    ended = command("compare", *words, "data.val=0", "split=val")
    assert (ended.code, ended.err) == (1, "split = val holds no video: choose another one.\n")
    assert not (tmp_path / "cmp").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "checkpoints is missing: write 'checkpoints=[a.ckpt, outputs/<run>/seed_0]'."),
        (("checkpoints=[none.ckpt]",), "checkpoint = none.ckpt does not exist: give a .ckpt file or a run folder."),
        (("checkpoints=apex-p2d-cpu", "frames=3"), "frames = 3 goes with video=... alone: leave it out."),
        (
            ("checkpoints=apex-p2d-cpu", "clips=[]"),
            "clips = [] is wrong: list should have at least 1 item after validation, not 0.",
        ),
        (
            ("checkpoints=apex-p2d-cpu", "accelerator=gpu"),
            "accelerator = 'gpu', but PyTorch finds no CUDA device: use accelerator=cpu or accelerator=auto.",
        ),
        (
            ("checkpoints=apex-p2d-cpu", "names=[a,b]"),
            "names holds 2 captions for 1 checkpoints: give one for each.",
        ),
        (
            ("checkpoints=apex-p2d-cpu", f"video={EXAMPLE}", "data=sprites"),
            "video and data are both given: compare on one after the other.",
        ),
        (
            ("checkpoints=apex-p2d-cpu", "model=space"),
            "model=space is for training: a checkpoint brings its own configuration; leave it out.",
        ),
    ],
)
def test_wrong_commands_are_refused_in_one_sentence(
    command: Callable[..., Ended], words: tuple[str, ...], said: str
) -> None:
    ended = command("compare", *words)
    assert (ended.code, ended.err) == (2, said + "\n")
