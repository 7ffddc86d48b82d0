"""What cannot be printed stops nothing."""

from __future__ import annotations

import io
import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import TextIO

import pytest

from apex_lab.base import console
from apex_lab.base.errors import UserError


def test_characters_that_a_terminal_lacks_are_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="latin-1"))
    console.setup()
    console.say("\u2713 done, \udcff")
    print("\u2713 printed by a library", flush=True)
    assert raw.getvalue().decode("latin-1") == "? done, \\udcff\n? printed by a library\n"


def leads_nowhere(stream: TextIO) -> bool:
    return os.path.samestat(os.fstat(stream.fileno()), os.stat(os.devnull))


def test_a_pipe_that_nobody_reads_ends_quietly(monkeypatch: pytest.MonkeyPatch) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    stream = open(writer, "w")  # noqa: SIM115 - closed below
    monkeypatch.setattr(sys, "stdout", stream)
    console.setup()
    console.say("one")
    console.say("two")
    assert leads_nowhere(stream)
    stream.close()  # what was left over goes nowhere, too


def test_what_libraries_print_into_such_a_pipe_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    monkeypatch.setattr(sys, "stdout", open(writer, "w"))  # noqa: SIM115 - closed below
    console.setup()
    print("much\n" * 10_000)
    print("a little", flush=True)
    assert leads_nowhere(sys.stdout)
    sys.stdout.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("train", "--cfg", "job"),
        ("train", "--help"),
        ("status", "--once", "+sweep=ablations", "scale=cpu"),
        ("status", "--help"),
        ("tables", "+sweep=ablations", "scale=cpu", "dry_run=true"),
    ],
)
def test_commands_into_a_pipe_that_nobody_reads(words: tuple[str, ...], tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as stream:
        ended = subprocess.run(
            [sys.executable, "-m", f"apex_lab.{words[0]}", *words[1:]],
            stdout=stream,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
        )
    assert (ended.returncode, ended.stderr) == (0, "")


def test_a_stream_that_is_closed_leads_nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    console.setup()
    console.say("nobody")
    print("hears this")
    assert sys.stdout.name == os.devnull
    sys.stdout.close()


@pytest.mark.slow
def test_files_do_not_get_the_number_of_a_closed_stream(tmp_path: Path) -> None:
    code = (
        "from apex_lab.base import console; console.setup(); import os; file = open('f', 'w'); console.say('x'); "
        "os.write(1, b'noise'); file.write('sound'); file.close()"
    )
    subprocess.run(["sh", "-c", f'exec "{sys.executable}" -c "{code}" >&-'], cwd=tmp_path, check=True)
    assert (tmp_path / "f").read_text() == "sound"


def test_a_log_that_can_be_written_no_longer_costs_one_warning(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    console.setup()
    with console.log_to(Path("/dev/full")):
        for number in range(3):
            console.say(f"step {number}")
    said = capsys.readouterr()
    assert said.out == "step 0\nstep 1\nstep 2\n"
    [line] = said.err.splitlines()
    assert "/dev/full cannot be written" in line
    assert "No space left" in line
    assert not any(isinstance(handler, logging.FileHandler) for handler in logging.getLogger("apex_lab").handlers)
    with pytest.raises(UserError, match="cannot be written"), console.log_to(tmp_path / "nowhere" / "log.txt"):
        pass
