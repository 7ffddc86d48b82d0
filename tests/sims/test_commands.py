"""How the simulator's commands end: a sentence and an exit code, whatever is typed and whatever happens."""

from __future__ import annotations

import importlib
import os
import re
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from recordings.streams import open_streams, say
from sims.command import ending
from sims.errors import SimError

KEPT = "all is kept"


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def raising(error: BaseException) -> Callable[[], int]:
    def work() -> int:
        raise error

    return work


def killing(signum: int) -> Callable[[], int]:
    def work() -> int:
        os.kill(os.getpid(), signum)
        raise AssertionError("nobody listens")

    return work


@pytest.mark.parametrize(
    ("work", "code", "told"),
    [
        (lambda: 7, 7, ""),
        (raising(SimError("seed is wrong: choose another")), 1, "seed is wrong: choose another\n"),
        (killing(signal.SIGTERM), 143, f"terminated; {KEPT}\n"),
        (killing(signal.SIGINT), 130, f"interrupted; {KEPT}\n"),
    ],
)
def test_how_work_ends(work: Callable[[], int], code: int, told: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = signal.getsignal(signal.SIGTERM)
    assert ending(work, KEPT) == code
    assert capsys.readouterr().err == told
    assert signal.getsignal(signal.SIGTERM) is before


def test_what_nobody_foresaw_is_a_sentence_and_a_file(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert ending(raising(ZeroDivisionError("by\nzero")), KEPT) == 1
    found = re.fullmatch(r"ZeroDivisionError: by zero \(traceback: (.+)\)\.\n", capsys.readouterr().err)
    assert found is not None
    assert "Traceback (most recent call last)" in Path(found.group(1)).read_text()
    assert ending(raising(PermissionError(13, "Permission denied", "/a/b")), KEPT) == 1
    assert capsys.readouterr().err.startswith("/a/b: Permission denied (traceback: ")
    assert ending(raising(ValueError("x" * 5000)), KEPT) == 1
    assert len(capsys.readouterr().err) < 600


def test_a_reader_that_has_gone_stops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    stream = open(writer, "w")  # noqa: SIM115 - closed below
    monkeypatch.setattr(sys, "stdout", stream)
    assert ending(lambda: say("one") or say("two") or 0, KEPT) == 0  # type: ignore[func-returns-value]
    stream.close()  # what was left over goes nowhere, too
    monkeypatch.setattr(sys, "stdout", None)
    say("nobody hears")
    open_streams()
    print("nor this")
    sys.stdout.close()


LONG = "x" * 5000
REFUSED = {
    "p2d.__main__ --out=": (2, "--out: it is empty, as an unset variable is: give a path"),
    f"p2d.__main__ --out={LONG}": (2, "--out: no path can be so"),
    "p2d.__main__ --out=/proc/x": (1, "/proc/x cannot be used as a folder (No such file or directory)"),
    "p2d.__main__ --set seed=nan": (2, "setting seed='nan' is not possible: input should be a valid integer"),
    "p2d.__main__ verify": (2, "the following arguments are required: dir"),
    "p2d.__main__ verify /etc --repair": (1, "no P2D data at /etc"),
    f"p2d.__main__ verify {LONG}": (2, "dir: no path can be so"),
    "p2d.__main__ card /nowhere": (1, "no P2D data at /nowhere"),
    "p2d.__main__ export /nowhere --format coco --out x": (1, "no P2D data at /nowhere"),
    "arrangement_clips.__main__ make /proc/x": (1, "/proc/x cannot be used as a folder"),
    "arrangement_clips.__main__ make x --settings {": (2, "--settings {: "),
    'arrangement_clips.__main__ make x --settings {"nix":3}': (2, "unknown setting 'nix': known are "),
    "arrangement_clips.__main__ make x --workers 0": (2, "--workers: 0 is not at least 1"),
    "arrangement_clips.__main__ verify /etc --repair": (1, "/etc"),
    "example_videos --out /proc/x": (1, "/proc/x cannot be used as a folder (No such file or directory)"),
    "example_videos --out x --videos 0": (2, "--videos 0 --frames 48: give numbers from 1 to 10000"),
    "example_videos --out x --size 5": (2, "setting image_size=5 is not possible: input should be greater than or"),
    "example_videos --out x --seed -1": (2, "setting seed=-1 is not possible"),
}


@pytest.mark.parametrize("line", REFUSED, ids=range(len(REFUSED)))
def test_what_is_refused(line: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    code, told = REFUSED[line]
    name, *words = line.split(" ")
    try:
        ended = importlib.import_module(f"sims.{name}").main(words)
    except SystemExit as stop:  # of argparse, which prints the usage too
        ended = stop.code
    said = capsys.readouterr()
    assert ended == code
    assert told in said.err
    assert "raceback" not in said.err
    assert said.out == ""
    assert list(tmp_path.iterdir()) == []
    assert not Path("/etc/.lock").exists()
