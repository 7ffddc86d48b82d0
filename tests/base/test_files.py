from __future__ import annotations

import errno
import json
import math
import re
from pathlib import Path
from typing import IO

import pytest
import torch

from apex_lab.base.errors import UserError
from apex_lab.base.files import (
    clear_drafts,
    make_folder,
    read_json,
    replacing,
    unwritable,
    write_json,
    write_text,
    writing,
)


def test_a_file_changes_only_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "note.txt"
    write_text(path, "before")

    def write_half() -> None:
        with replacing(path) as file:
            file.write(b"half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        write_half()
    assert path.read_text() == "before"
    write_text(path, "after")
    assert path.read_text() == "after"
    assert [file.name for file in tmp_path.iterdir()] == ["note.txt"]


def test_json_has_null_for_what_is_not_a_number(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    write_json(path, {"a": math.nan, "b": [1.0, math.inf], "c": {"d": (1, -math.inf)}, 5: "é"})
    assert json.loads(path.read_text()) == {"a": None, "b": [1.0, None], "c": {"d": [1, None]}, "5": "é"}
    assert read_json(path)["b"] == [1.0, None]


@pytest.mark.parametrize("text", ["", "{", "[1]", "3"])
def test_damaged_json_is_named(text: str, tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    path.write_text(text)
    with pytest.raises(UserError, match=str(path)):
        read_json(path)


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="file/inside cannot be written"):
        make_folder(tmp_path / "file" / "inside")
    with pytest.raises(UserError, match=r"missing/note\.txt cannot be written"):
        write_text(tmp_path / "missing" / "note.txt", "")


def test_a_full_disk_is_told_with_its_free_space(tmp_path: Path) -> None:
    free = r"\(\d+(\.\d)? (GB|MB|kB|bytes) free there\)"
    for error in (
        OSError(errno.ENOSPC, "No space left on device"),
        OSError("ffmpeg: av_write: No space left on device"),
    ):
        sentence = str(unwritable(tmp_path / "no" / "file", error))
        assert re.match(rf"No space left for {re.escape(str(tmp_path))}/no/file {free}: free some and run", sentence)
    assert "(Disk quota exceeded; " in str(unwritable(tmp_path, OSError(errno.EDQUOT, "")))
    with pytest.raises(UserError, match=r"No space left for .*/file"), writing(tmp_path / "file"):
        raise OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(OSError, match="elsewhere"), writing(tmp_path / "file"):
        raise OSError(errno.EIO, "elsewhere")


class Filling:
    """A file on a disk that has room for small pieces alone."""

    def __init__(self, file: IO[bytes]) -> None:
        self.file = file

    def write(self, piece: bytes) -> int:
        if len(piece) > 1000:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self.file.write(piece)


def test_a_full_disk_is_told_when_torch_writes(tmp_path: Path) -> None:
    def save() -> None:
        with replacing(tmp_path / "state.pt") as file:
            torch.save([torch.zeros(20_000)], Filling(file))  # type: ignore[arg-type]

    with pytest.raises(UserError, match=r"No space left for .*/state\.pt"):
        save()
    assert not list(tmp_path.iterdir())


def test_what_a_kill_left_of_a_file_is_removed(tmp_path: Path) -> None:
    left = [".a.csv.7.apex_lab.part", ".a.csv.12.apex_lab.part", ".ab.csv.7.apex_lab.part", ".a.csv.part", "a.csv"]
    for name in left:
        (tmp_path / name).touch()
    clear_drafts(tmp_path, ["a.csv", "b.csv"])
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(left[2:])
