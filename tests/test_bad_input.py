"""What commands cannot be done with: one sentence, before anything is read or made."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from apex_lab.base.errors import UserError
from apex_lab.runs.checkpoint_files import find
from apex_lab.videos import find_videos
from tests.conftest import REPOSITORY, Ended

WEIGHTS, VIDEO = "checkpoint=apex-p2d-cpu", f"video={REPOSITORY / 'examples' / 'pushing.mp4'}"
EMPTY, LONG = "it is empty, as an unset variable is: give a path", "x" * 5000

REFUSED = {
    ("predict", "checkpoint=", VIDEO): f"checkpoint = '' is wrong: {EMPTY}.",
    ("predict", f"checkpoint={LONG}", VIDEO): "is wrong: no path can be so (File name too long).",
    ("predict", WEIGHTS, "video="): f"video = '' is wrong: {EMPTY}.",
    ("predict", WEIGHTS, f"video={LONG}"): "is wrong: no path can be so (File name too long).",
    ("predict", WEIGHTS, "video=a***b"): "video = a***b is no pattern (Invalid pattern",
    ("predict", WEIGHTS, f"video={10**30}"): f"video = {10**30} is no camera: they are numbered from 0 on.",
    ("predict", WEIGHTS, VIDEO, f"every={10**30}"): "every = a whole number of 100 bits is wrong",
    ("predict", WEIGHTS, VIDEO, "folder="): f"folder = '' is wrong: {EMPTY}.",
    ("predict", WEIGHTS, VIDEO, f"folder={LONG}"): "is wrong: no path can be so (File name too long).",
    ("compare", "checkpoints="): f"checkpoint = '' is wrong: {EMPTY}.",
    ("compare", "checkpoints=apex-p2d-cpu", "video="): f"video = '' is wrong: {EMPTY}.",
    ("compare", "checkpoints=apex-p2d-cpu", "clips=[]"): "clips = [] is wrong: list should have at least 1 item",
    ("compare", "checkpoints=apex-p2d-cpu", f"clips=[{10**21}]"): "clips[0] = a whole number of 70 bits is wrong",
    ("arrange", "checkpoint="): f"checkpoint = '' is wrong: {EMPTY}.",
    ("arrange", f"checkpoint={LONG}"): "is wrong: no path can be so (File name too long).",
    ("arrange", "perception=oracle", f"seed={10**30}"): "seed = a whole number of 100 bits is wrong",
    ("arrange", "perception._target_=builtins.print"): "is set by the files that were chosen, and builtins.print does",
    ("evaluate", "checkpoint="): f"checkpoint = '' is wrong: {EMPTY}.\n",
    ("evaluate", "checkpoint=a***b"): "checkpoint = a***b is no pattern (Invalid pattern",
    ("evaluate", WEIGHTS, "data=sprites", "data.frames=100000000"): "frames of whole videos would take",
    ("evaluate", WEIGHTS, "--config-dir="): f"--config-dir = '' is wrong: {EMPTY}.",
    # the sweep's first job could start, its second has no data
    ("train", "seed=0,1", "data=p2d,sketchy", "-m"): "sketchy_demos_128px is not there: prepare it with python -m",
    (
        "train",
        "seed=0,1",
        "data=video",
        "data.path=gone",
        "scale=cpu",
        "-m",
    ): "data.path = gone does not exist: give a folder",
    ("train", "data.generate=true,false", "-m"): "no finished P2D data at",
    ("tables", "+sweep=glob(*)"): "+sweep=glob(*) is a pattern, which fits files of a group alone: name the values.",
    ("tables", "tabels=[1]"): "Unknown key tabels=[1]; did you mean 'tables'?\n",
    ("status", "seed=range(1000000000)"): "seed=range(1000000000) holds more than 100,000 values: name fewer.",
    ("status", "+sweep=paper.yaml"): "sweep=paper.yaml is no name of a choice: write sweep=paper.",
    ("report.asked", "folder=a,b"): "folder=a,b holds several values, and there is one report: give one.",
    ("report.asked", "tables=[99]"): "tables = [99] is wrong: there are 1, 2, 3, 4.",
}


@pytest.mark.parametrize("words", REFUSED, ids=range(len(REFUSED)))
def test_refused_before_anything_starts(words: tuple[str, ...], command: Callable[..., Ended], tmp_path: Path) -> None:
    ended = command(*words)
    assert ended.code == 2, ended.err
    assert REFUSED[words] in ended.err
    assert "raceback" not in ended.err
    assert len(ended.err.splitlines()) == 1
    assert ended.out == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("read", [find, find_videos])
def test_folders_that_cannot_be_looked_through(
    read: Callable[[list[str]], object], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def glob(self: Path, pattern: str) -> object:
        raise OSError(22, "Invalid argument", "/proc/1/net")

    monkeypatch.setattr(Path, "glob", glob)
    with pytest.raises(UserError, match=r"/\*/x leads to /proc/1/net \(Invalid argument\): give a narrower one\."):
        read(["/*/x"])


def test_what_nobody_foresaw_of_one_video_is_a_sentence(
    command: Callable[..., Ended], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> str:
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr("apex_lab.predict.predict_video", broken)
    ended = command("predict", WEIGHTS, VIDEO)
    assert ended.code == 1
    [line] = ended.err.splitlines()
    assert "pushing.mp4: ZeroDivisionError: by zero (traceback: " in line


def test_ctrl_c_while_runs_are_read(command: Callable[..., Ended], monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*_: object) -> object:
        raise KeyboardInterrupt

    monkeypatch.setattr("apex_lab.status.looking", stopped)
    assert command("status") == Ended(130, "", "Stopped by SIGINT.\n")
