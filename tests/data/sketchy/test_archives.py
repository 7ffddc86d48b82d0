"""Archives: what comes out is what went in; damaged ones give what is whole; hostile ones give nothing."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from apex_lab.base.errors import UserError
from apex_lab.data.sketchy import archives
from apex_lab.data.sketchy.archives import extract_all
from apex_lab.data.sketchy.files import find
from tests.data.sketchy.episodes import episode_name

pytestmark = pytest.mark.skipif(not hasattr(tarfile, "data_filter"), reason="Python before 3.11.4 has no filter")


def content(number: int) -> bytes:
    """What stands for an episode here: extraction does not look into files."""
    return bytes([number]) * (3000 + number)


def pack(path: Path, numbers: Sequence[int], *more: tarfile.TarInfo, folder: str = "") -> Path:
    """An archive of episodes, and of members without content behind the first episode."""
    with tarfile.open(path, "w:bz2") as tar:
        for place, number in enumerate(numbers):
            member = tarfile.TarInfo(folder + episode_name(number))
            member.size = len(content(number))
            tar.addfile(member, io.BytesIO(content(number)))
            if place == 0:
                for other in more:
                    tar.addfile(other, io.BytesIO(bytes(other.size)))
    return path


def member(name: str, kind: bytes = tarfile.REGTYPE, link: str = "") -> tarfile.TarInfo:
    found = tarfile.TarInfo(name)
    found.type, found.linkname = kind, link
    found.size = 10 if kind == tarfile.REGTYPE else 0
    return found


def test_episodes_of_several_archives(tmp_path: Path) -> None:
    first = pack(tmp_path / "a-00000-of-00002.tar.bz2", [1, 4], member("README"), member("folder", tarfile.DIRTYPE))
    second = pack(tmp_path / "a-00001-of-00002.tar.bz2", [2, 4], folder="a/")
    episodes, problems = extract_all([first, second], tmp_path / "out", workers=2)
    assert problems == []
    assert sorted(episodes) == [episode_name(number) for number in (1, 2, 4)]
    for number in (1, 2, 4):
        assert episodes[episode_name(number)].read_bytes() == content(number)
    assert episodes[episode_name(4)].parent.name == "a-00000-of-00002"
    assert not list((tmp_path / "out").rglob("README"))


def test_nothing_is_extracted_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archive = pack(tmp_path / "a.tar.bz2", [1, 2, 3])
    before, _ = extract_all([archive], tmp_path / "out", 1)
    monkeypatch.setattr(archives, "_members", lambda *_: pytest.fail("the archive was read again"))
    assert extract_all([archive], tmp_path / "out", 1) == (before, [])
    monkeypatch.undo()
    before[episode_name(2)].unlink()  # deleted: comes back, and the others are not written again
    kept = before[episode_name(1)].stat().st_mtime_ns
    after, _ = extract_all([archive], tmp_path / "out", 1)
    assert after[episode_name(2)].read_bytes() == content(2)
    assert after[episode_name(1)].stat().st_mtime_ns == kept


def test_an_interrupted_extraction_keeps_whole_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archive = pack(tmp_path / "a.tar.bz2", [1, 2, 3])
    copied: list[str] = []
    original = archives._copy

    def copy(tar: tarfile.TarFile, found: tarfile.TarInfo, *rest: object) -> None:
        if len(copied) == 2:
            raise KeyboardInterrupt
        copied.append(found.name)
        original(tar, found, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(archives, "_copy", copy)
    with pytest.raises(KeyboardInterrupt):
        extract_all([archive], tmp_path / "out", 1)
    there = sorted(path.name for path in (tmp_path / "out" / "a").iterdir())
    assert there == [episode_name(1), episode_name(2)]
    monkeypatch.undo()
    episodes, problems = extract_all([archive], tmp_path / "out", 1)
    assert problems == []
    assert [path.read_bytes() for _, path in sorted(episodes.items())] == [content(number) for number in (1, 2, 3)]


@pytest.mark.parametrize(
    ("hostile", "sentence"),
    [
        (member("../outside"), "leads outside"),
        (member(f"../{episode_name(7)}"), "leads outside"),
        (member("/outside"), "leads outside"),
        (member("a/../../outside"), "leads outside"),
        (member(episode_name(7), tarfile.SYMTYPE, "/etc/passwd"), "no plain file"),
        (member(episode_name(7), tarfile.SYMTYPE, episode_name(1)), "no plain file"),
        (member(episode_name(7), tarfile.LNKTYPE, episode_name(1)), "no plain file"),
        (member("device", tarfile.CHRTYPE), "no plain file"),
        (member("pipe", tarfile.FIFOTYPE), "no plain file"),
    ],
)
def test_a_hostile_archive_is_refused_as_a_whole(tmp_path: Path, hostile: tarfile.TarInfo, sentence: str) -> None:
    sound = pack(tmp_path / "sound.tar.bz2", [1])
    bad = pack(tmp_path / "bad.tar.bz2", [2, 3], hostile)
    before = sorted(tmp_path.iterdir())
    episodes, problems = extract_all([bad, sound], tmp_path / "out", 1)
    assert list(episodes) == [episode_name(1)]
    assert len(problems) == 1
    assert problems[0].startswith("bad.tar.bz2: it holds ")
    assert sentence in problems[0]
    assert sorted(tmp_path.iterdir()) == [*before[:1], tmp_path / "out", *before[1:]]
    assert [path.name for path in (tmp_path / "out" / "bad").iterdir()] == [archives.DONE]
    assert extract_all([bad], tmp_path / "out", 1)[1] == problems  # refused again without being read


def cut(data: bytes) -> bytes:
    return data[: len(data) * 2 // 3]


def changed(data: bytes) -> bytes:
    return data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 1]) + data[len(data) // 2 + 1 :]


def without_its_end(data: bytes) -> bytes:
    return data[:-10]


def no_archive(data: bytes) -> bytes:
    return b"<html>not found</html>"


@pytest.mark.parametrize("damage", [cut, changed, without_its_end, no_archive, lambda data: b""])
def test_of_a_damaged_archive_only_whole_episodes_are_used(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    archive = tmp_path / "a.tar.bz2"
    with tarfile.open(archive, "w:bz2", compresslevel=1) as tar:  # blocks of 100 kB
        for number in range(8):
            found = tarfile.TarInfo(episode_name(number))
            data = np.random.default_rng(number).bytes(100_000)
            found.size = len(data)
            tar.addfile(found, io.BytesIO(data))
    archive.write_bytes(damage(archive.read_bytes()))
    episodes, problems = extract_all([archive], tmp_path / "out", 1)
    assert len(problems) == 1
    assert problems[0].startswith(f"a.tar.bz2: it is cut off or damaged after {len(episodes)} episodes")
    assert len(episodes) < 8 or damage is without_its_end
    for number in range(len(episodes)):
        data = np.random.default_rng(number).bytes(100_000)
        assert episodes[episode_name(number)].read_bytes() == data
    assert not list((tmp_path / "out").rglob("*.part"))


def test_a_full_disk_is_told_and_nothing_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archive = pack(tmp_path / "a.tar.bz2", [1, 2])

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(archives, "_copy", full)
    with pytest.raises(UserError, match="No space left"):
        extract_all([archive], tmp_path / "out", 1)
    monkeypatch.undo()
    assert len(extract_all([archive], tmp_path / "out", 1)[0]) == 2


def test_what_a_folder_holds(tmp_path: Path) -> None:
    one, two = episode_name(1), episode_name(2)
    for name in (f"b/{two}", one, f"c/{two}", f".hidden/{episode_name(5)}", "notes"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    for number in (0, 3):
        (tmp_path / f"rgb30__all-{number:05d}-of-00005.tar.bz2").write_bytes(b"")
    found = find(tmp_path)
    assert found.episodes == {one: tmp_path / one, two: tmp_path / "b" / two}
    assert len(found.archives) == 2
    assert "twice" in found.remarks[0]
    assert str(tmp_path / "c" / two) in found.remarks[0]
    assert found.remarks[1].startswith("rgb30__all: 3 of 5 archives are missing (00001, 00002, 00004)")


def test_a_folder_without_data_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds neither episodes"):
        find(tmp_path)
    with pytest.raises(UserError, match="is not a folder"):
        find(tmp_path / "missing")
