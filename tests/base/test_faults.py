"""The net under everything: one sentence, and a file with the traceback."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

import pytest

from apex_lab.base import faults
from apex_lab.base.errors import UserError


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def test_an_exception_becomes_a_sentence_that_names_the_file_with_its_traceback(tmp_path: Path) -> None:
    with pytest.raises(UserError) as caught, faults.net("model"):
        raise KeyError("no such\nlayer")
    sentence = str(caught.value)
    found = re.fullmatch(r"model: KeyError: 'no such\\nlayer' \(traceback: (.+)\)\.", sentence)
    assert found is not None, sentence
    text = Path(found.group(1)).read_text()
    assert "Traceback (most recent call last)" in text
    assert "in test_an_exception_becomes" in text


def test_a_sentence_stays_as_it_is(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"^seed is wrong\.$"), faults.net("model"):
        raise UserError("seed is wrong.")
    assert list(tmp_path.iterdir()) == []


def test_what_the_system_says_of_a_file_names_it() -> None:
    assert faults.cited(PermissionError(13, "Permission denied", "/a/b")) == "/a/b: Permission denied"
    assert len(faults.cited(OSError(36, "File name too long", "x" * 5000))) < 500
    assert len(faults.cited(ValueError("x" * 5000))) < 500
    assert faults.cited(ValueError()) == "ValueError"


def test_without_a_place_for_the_file_the_sentence_remains(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", "/proc/nowhere")
    with (
        pytest.raises(UserError, match=r"^ZeroDivisionError: .* \(its traceback could not be stored: .*\)\.$"),
        faults.net(),
    ):
        raise ZeroDivisionError("division by zero")
