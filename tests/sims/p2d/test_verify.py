"""Damage of every kind is found, named and repaired; only damaged trajectories are generated again."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from recordings import MANIFEST, is_verified, verify
from recordings.plan import digest
from recordings.verify import VERIFIED
from sims.errors import SimError
from sims.p2d.generate import generate, repair
from sims.p2d.store import FIELDS, KIND, check, read_manifest
from tests.fakes.p2d_tools import FAKE, content, make, small, start


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("made") / "p2d"
    make(root)
    return root


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    """A copy to damage."""
    return Path(shutil.copytree(made, tmp_path / "p2d"))


def flip(path: Path, position: int) -> None:
    """Flips one bit; a negative position counts from the end."""
    data = bytearray(path.read_bytes())
    data[position] ^= 0b100
    path.write_bytes(data)


def repaired(root: Path, log: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Repairs; returns which trajectories were simulated, as split-index."""
    log.mkdir()
    monkeypatch.setenv("FAKE_LOG", str(log))
    repair(root, workers=1, simulator=FAKE, shown=False)
    return sorted("-".join(path.name.split("-")[:2]) for path in log.iterdir())


def test_undamaged_data_pass(root: Path):
    assert check(root, small()) == read_manifest(root)
    damage = verify(root, read_manifest(root), shown=False)
    assert not damage
    assert damage.lines() == []


@pytest.mark.parametrize("name", FIELDS)
def test_a_flipped_bit_in_any_array_is_found(root: Path, name: str):
    flip(root / "train" / f"{name}.npy", -1)
    check(root)  # too cheap to see it
    damage = verify(root, read_manifest(root), shown=False)
    assert damage.lines() == ["trajectory train/7: bytes do not match the checksum"]


def test_only_trajectories_with_flipped_bits_are_generated_again(
    root: Path, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    flip(root / "train" / "rgb.npy", -1)
    flip(root / "val" / "redraws.npy", 128)
    assert repaired(root, tmp_path / "log", monkeypatch) == ["train-7", "val-0"]
    assert content(root) == content(made)
    assert not verify(root, read_manifest(root), shown=False)


def test_many_damaged_trajectories_are_named_as_ranges(root: Path):
    for index in (0, 2, 3, 4, 7):
        flip(root / "train" / "segmentation.npy", 128 + index * 3 * 16 * 16)
    flip(root / "val" / "joints.npy", -1)
    assert verify(root, read_manifest(root), shown=False).lines() == [
        f"trajectory {name}: bytes do not match the checksum" for name in ("train/0", "train/2-4", "train/7", "val/1")
    ]


def header_bit(root: Path) -> None:
    flip(root / "train" / "depth.npy", 100)


def truncated(root: Path) -> None:
    os.truncate(root / "train" / "rgb.npy", 128 + 6 * 3 * 16 * 16 * 3 + 5)


def missing(root: Path) -> None:
    (root / "val" / "poses.npy").unlink()


def too_long(root: Path) -> None:
    with open(root / "test" / "aimed.npy", "ab") as file:
        file.write(b"\0")


DAMAGES = [
    (header_bit, "train/depth.npy has a damaged header", []),
    (truncated, "train/rgb.npy is truncated (13957 of 18560 bytes)", ["train-6", "train-7"]),
    (missing, "val/poses.npy is missing", ["val-0", "val-1"]),
    (too_long, "test/aimed.npy is too long (131 bytes, not 130)", []),
]


@pytest.mark.parametrize(("damage", "sentence", "again"), DAMAGES, ids=[case[0].__name__ for case in DAMAGES])
def test_damaged_files_are_found_at_every_start_and_repaired(
    root: Path,
    made: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    damage: Callable[[Path], None],
    sentence: str,
    again: list[str],
):
    damage(root)
    with pytest.raises(SimError) as caught:
        check(root)
    assert str(caught.value) == f"{root}/{sentence}: repair it with python -m sims.p2d verify {root} --repair"
    with pytest.raises(SimError, match="repair it with"):
        generate(root, small(), simulator=FAKE)
    found = verify(root, read_manifest(root), shown=False)
    assert found.files == [f"{root}/{sentence}"]
    assert repaired(root, tmp_path / "log", monkeypatch) == again
    assert content(root) == content(made)


@pytest.mark.parametrize("position", [5, 300, -40])
def test_a_damaged_manifest_is_found_and_repaired_from_the_journal(
    root: Path, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, position: int
):
    flip(root / MANIFEST, position)
    with pytest.raises(SimError, match=r"manifest.json is damaged: repair it with"):
        check(root)
    assert repaired(root, tmp_path / "log", monkeypatch) == []
    assert content(root) == content(made)


def test_every_flipped_bit_of_a_manifest_is_refused_in_one_sentence(root: Path):
    whole = (root / MANIFEST).read_bytes()
    for position in range(0, len(whole), 97):
        data = bytearray(whole)
        data[position] ^= 1 << (position % 8)
        (root / MANIFEST).write_bytes(data)
        if _json(bytes(data)) == _json(whole):
            continue  # white space or the spelling of a number
        with pytest.raises(SimError):
            check(root)


def _json(text: bytes) -> object:
    try:
        return json.loads(text)
    except ValueError:
        return None


def test_another_format_is_refused(root: Path):
    data = json.loads((root / MANIFEST).read_text())
    (root / MANIFEST).write_text(json.dumps({**data, "format": 7}))
    for command in (check, lambda path: repair(path, simulator=FAKE)):
        with pytest.raises(
            SimError, match="was written in format 7 and this program reads format 1: generate the data again"
        ):
            command(root)


def test_settings_of_a_later_version_are_refused(root: Path):
    data = json.loads((root / MANIFEST).read_text())
    data["settings"]["wind_m_s"] = 3
    data.pop("checksum")
    data["checksum"] = digest(data)
    (root / MANIFEST).write_text(json.dumps(data))
    with pytest.raises(SimError, match="made by another version of this program"):
        check(root)


def test_differing_settings_are_named_by_key(root: Path):
    with pytest.raises(SimError, match="image_size is 16 there and 32 here"):
        check(root, small(image_size=32))


def test_missing_and_unfinished_folders_are_reported(tmp_path: Path):
    with pytest.raises(SimError, match=f"no P2D data at {tmp_path}/none: make them with python -m sims.p2d --out"):
        check(tmp_path / "none")
    with pytest.raises(SimError, match="no P2D data at"):
        repair(tmp_path / "none", simulator=FAKE)
    with pytest.raises(SimError, match="no P2D data at"):
        check(tmp_path)


def test_a_repair_never_writes_other_bytes(root: Path, monkeypatch: pytest.MonkeyPatch):
    flip(root / "train" / "rgb.npy", -1)
    before = content(root)
    monkeypatch.setenv("FAKE_OTHER_BYTES", "1")
    with pytest.raises(SimError, match="trajectory train/7 came out with other bytes than those recorded"):
        repair(root, workers=1, simulator=FAKE, shown=False)
    assert content(root) == before


def test_a_killed_repair_can_be_started_again(root: Path, made: Path):
    for index in range(8):
        flip(root / "train" / "rgb.npy", 128 + index * 3 * 16 * 16 * 3)
    log = root.parent / "log"
    log.mkdir()
    process = start("verify", root, "--repair", "--workers", 1, FAKE_LOG=log, FAKE_SLEEP_S=0.2)
    while len(list(log.iterdir())) < 3:
        assert process.poll() is None
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert 0 < len(verify(root, read_manifest(root), shown=False).items) < 8
    again = start("verify", root, "--repair", "--workers", 1)
    text, _ = again.communicate(timeout=120)
    assert again.returncode == 0
    assert f"{root}: repaired" in text
    assert content(root) == content(made)


def test_an_untouched_folder_needs_no_second_full_check(root: Path):
    manifest = read_manifest(root)
    assert not is_verified(root, manifest)  # a copy is another folder
    verify(root, manifest, shown=False)
    assert is_verified(root, manifest)


def test_a_fresh_folder_counts_as_checked(made: Path):
    assert is_verified(made, read_manifest(made))


def test_any_change_needs_a_full_check_even_with_its_time_reset(root: Path):
    manifest = read_manifest(root)
    verify(root, manifest, shown=False)
    path = root / "test" / "segmentation.npy"
    old = path.stat()
    with open(path, "r+b") as file:
        file.seek(1000)
        file.write(b"\x05")
    os.utime(path, ns=(old.st_atime_ns, old.st_mtime_ns))
    assert path.stat().st_mtime_ns == old.st_mtime_ns
    assert not is_verified(root, manifest)
    assert verify(root, manifest, shown=False)
    assert not is_verified(root, manifest)


def test_a_damaged_record_of_the_last_check_is_ignored(root: Path):
    verify(root, read_manifest(root), shown=False)
    (root / VERIFIED).write_text("{")
    assert not is_verified(root, read_manifest(root))


def test_manifest_and_journal_both_damaged_is_reported(root: Path):
    flip(root / MANIFEST, 5)
    (root / KIND.journal).unlink()
    with pytest.raises(
        SimError, match=r"is damaged and trajectories\.jsonl is missing: delete the folder, if it holds nothing else"
    ):
        repair(root, simulator=FAKE)
