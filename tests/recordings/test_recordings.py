"""Any kind of recording: made by several processes, resumed, checked, repaired, and told from other kinds."""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from recordings import (
    MANIFEST,
    Field,
    Layout,
    Maker,
    Reader,
    RecordingError,
    check,
    is_verified,
    read_manifest,
    record,
    repair,
    verify,
)
from tests.fakes.p2d_tools import content
from tests.fakes.p2d_tools import make as make_p2d
from tests.fakes.recordings_fake import KIND, Squares, plan

JOURNAL = "squares.jsonl"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("made") / "squares"
    record(root, plan(), Squares(), workers=0, shown=False)
    return root


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    """A copy to damage."""
    return Path(shutil.copytree(made, tmp_path / "squares"))


def mended(root: Path) -> list[str]:
    return repair(root, KIND, lambda plan, facts: Squares(plan.settings["seed"]), workers=0, shown=False).lines()


def test_arrays_notes_and_manifest_read_back(made: Path):
    reader = Reader(made, KIND, "extra")
    assert len(reader) == 2
    np.testing.assert_array_equal(reader.array("value"), np.float32([100, 101]))
    np.testing.assert_array_equal(reader.array("rgb")[1], np.full((2, 4, 4, 3), 101, np.uint8))
    assert reader.notes(1) == {"name": "extra 1", "weight": 1}
    manifest = reader.manifest
    assert manifest.settings == {"seed": 0, "palette": ["red", "blue"]}
    assert manifest.facts == {"versions": {"squares": "1"}, "where": "here"}
    assert manifest.layout == plan().layout
    assert manifest.fingerprint == plan().fingerprint
    stored = json.loads((made / MANIFEST).read_text())
    assert (stored["kind"], stored["splits"]["train"]["weight_total"]) == ("squares", 10)
    assert "| `value.npy` | float32 | (N) | its brightness |" in (made / "README.md").read_text()


def test_a_reader_is_pickled_without_its_maps(made: Path):
    reader = Reader(made, KIND, "train")
    reader.array("rgb")
    again = pickle.loads(pickle.dumps(reader))
    assert again._arrays == {}
    assert again.array("rgb").shape == (5, 2, 4, 4, 3)


def test_an_interrupted_recording_is_resumed_to_the_same_bytes(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    root, log = tmp_path / "squares", tmp_path / "log"
    log.mkdir()
    with monkeypatch.context() as patch:
        patch.setenv("SQUARES_REFUSE", "train-3")
        with pytest.raises(RecordingError, match=r"^this square cannot be made$"):
            record(root, plan(), Squares(), workers=0, shown=False)
    with pytest.raises(RecordingError, match=r"not finished \(3 of 7 squares made\): resume with make squares in"):
        read_manifest(root, KIND)
    with pytest.raises(RecordingError, match=r"started with other settings \(seed is 0 there and 1 here\)"):
        record(root, plan(seed=1), Squares(1), workers=0, shown=False)
    later = dataclasses.replace(KIND, version=2)
    with pytest.raises(RecordingError, match=r"started by another version of this program: generate the data again"):
        record(root, plan(kind=later), Squares(), workers=0, shown=False)
    monkeypatch.setenv("SQUARES_LOG", str(log))
    record(root, plan(), Squares(), workers=2, shown=False)
    assert sorted(path.name for path in log.iterdir()) == ["extra-0", "extra-1", "train-3", "train-4"]
    assert content(root) == content(made)


@pytest.mark.parametrize(
    ("other", "what"),
    [
        (plan(seed=3), "seed is 0 there and 3 here"),
        (plan(train=6), "train has 5 squares there and 6 here"),
        (plan(side=5), "its arrays have other types or shapes"),
        (plan(kind=dataclasses.replace(KIND, version=2)), "another version of the program made them"),
    ],
)
def test_every_part_of_a_plan_is_in_its_fingerprint(made: Path, other, what: str):
    assert other.fingerprint != plan().fingerprint
    with pytest.raises(RecordingError, match=what):
        check(made, other.kind, other)


def test_a_folder_of_another_kind_is_refused(made: Path, tmp_path: Path):
    from sims.p2d.store import check as check_p2d

    make_p2d(tmp_path / "p2d")
    with pytest.raises(RecordingError, match="holds squares, not P2D"):
        check_p2d(made)
    with pytest.raises(RecordingError, match="holds data of another kind, not squares"):
        check(tmp_path / "p2d", KIND)
    circles = dataclasses.replace(KIND, name="circles")
    with pytest.raises(RecordingError, match="holds squares, not circles"):
        check(made, circles)


def test_damage_is_found_and_only_that_is_made_again(
    root: Path, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    log = tmp_path / "log"
    log.mkdir()
    monkeypatch.setenv("SQUARES_LOG", str(log))
    path = root / "extra" / "value.npy"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    (root / "train" / "rgb.npy").unlink()
    assert verify(root, read_manifest(root, KIND), shown=False).lines() == [
        f"{root}/train/rgb.npy is missing",
        *(f"square {name}: bytes do not match the checksum" for name in ("train/0-4", "extra/1")),
    ]
    mended(root)
    assert len(list(log.iterdir())) == 6
    assert content(root) == content(made)


@pytest.mark.parametrize("damage", ["emptied", "removed", "shortened", "changed"])
def test_a_damaged_journal_is_found_and_written_again(root: Path, made: Path, damage: str, monkeypatch):
    path = root / JOURNAL
    lines = path.read_bytes().splitlines(keepends=True)
    changed = {"emptied": b"", "shortened": b"".join(lines[:-1]), "changed": b"".join([*lines[:-1], lines[0]])}
    if damage == "removed":
        path.unlink()
    else:
        path.write_bytes(changed[damage])
    monkeypatch.setenv("SQUARES_REFUSE", "train-0")  # nothing has to be made
    found = verify(root, read_manifest(root, KIND), shown=False)
    assert found.lines() == [f"{path} is missing or damaged"]
    assert mended(root) == found.lines()
    assert content(root) == content(made)
    assert is_verified(root, read_manifest(root, KIND))


def test_a_damaged_manifest_is_written_again_from_the_journal(root: Path, made: Path):
    (root / MANIFEST).write_text("{")
    assert mended(root) == [f"{root / MANIFEST} is damaged"]
    assert content(root) == content(made)


def test_repairing_another_folder_leaves_nothing_behind(tmp_path: Path):
    with pytest.raises(RecordingError, match="no squares data at"):
        mended(tmp_path)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / MANIFEST).write_text('{"name": "an extension of a browser"}')
    with pytest.raises(RecordingError, match=r"is damaged and squares\.jsonl is missing: delete the folder, if it"):
        mended(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [MANIFEST]
    (tmp_path / MANIFEST).write_text('{"format": 1, "kind": ' + "[" * 100_000)
    with pytest.raises(RecordingError, match=r"is damaged"):
        mended(tmp_path)


def test_a_file_that_the_maker_misses_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SQUARES_UNREADABLE", "1")
    with pytest.raises(RecordingError, match=r"^/no such folder/palette cannot be used \(No such file or directory\)"):
        record(tmp_path / "a", plan(), Squares(), workers=0, shown=False)


def test_an_item_that_does_not_fit_is_refused(tmp_path: Path):
    with pytest.raises(RecordingError, match=r"square field rgb is \|u1 \(2, 3, 3, 3\), not \|u1 \(2, 4, 4, 3\)"):
        record(tmp_path, plan(), Squares(side=3), workers=0, shown=False)


def test_a_maker_of_the_main_script_is_refused(tmp_path: Path):
    class Lost(Maker):
        def make(self, split, index):
            raise NotImplementedError

    Lost.__module__ = "__main__"
    with pytest.raises(ValueError, match="workers can only import it from a module"):
        record(tmp_path, plan(), Lost(), workers=1)


@pytest.mark.parametrize("size", [0, -1, 2**70, True, "4", None, [4]])
def test_strange_sizes_in_a_manifest_are_refused(root: Path, size: object):
    from recordings.plan import digest

    data = json.loads((root / MANIFEST).read_text())
    data["sizes"]["S"] = size
    data.pop("checksum")
    (root / MANIFEST).write_text(json.dumps({**data, "checksum": digest(data)}))
    with pytest.raises(RecordingError):
        check(root, KIND)


def test_names_that_lead_out_of_the_folder_are_refused():
    for name in ("../x", "a/b", "", "a.b"):
        with pytest.raises(ValueError, match="cannot be the name"):
            Layout({name: Field("|u1")}, {"train": 1})
        with pytest.raises(ValueError, match="cannot be the name"):
            Layout({"rgb": Field("|u1")}, {name: 1})
    for dtype in ("O", "uint8", "<f4,<f4"):
        with pytest.raises((ValueError, TypeError)):
            Field(dtype)


def test_an_unreadable_manifest_is_reported(root: Path):
    (root / MANIFEST).unlink()
    (root / MANIFEST).mkdir()
    with pytest.raises(RecordingError, match=r"manifest.json cannot be read \(Is a directory\)"):
        check(root, KIND)
    assert os.listdir(root / MANIFEST) == []
