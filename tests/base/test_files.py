from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, read_json, replacing, write_json, write_text


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
