"""The command from a folder of episodes to a recording: order, splits, what is left out, and what is resumed."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tarfile
import time
from pathlib import Path

import numpy as np
import pytest

from apex_lab.data.sketchy import files
from apex_lab.data.sketchy.command import main
from apex_lab.data.sketchy.recording import KIND, episodes_of, plan
from apex_lab.data.sketchy.split import split_by_name
from recordings import Reader
from tests.data.sketchy.episodes import episode_name, level, write_episode


@pytest.mark.parametrize(
    ("count", "sizes"), [(9, (0, 0, 9)), (10, (1, 1, 8)), (19, (1, 1, 17)), (20, (2, 2, 16)), (25, (2, 2, 21))]
)
def test_a_tenth_validates_and_a_tenth_tests(count: int, sizes: tuple[int, int, int]) -> None:
    names = [f"{number}_x" for number in range(count)]
    parts = split_by_name(names[::-1])
    assert tuple(len(parts[split]) for split in ("val", "test", "train")) == sizes
    assert parts["val"] + parts["test"] + parts["train"] == sorted(names)  # as strings: 10_x before 2_x


def folder_of(tmp_path: Path, lengths: dict[int, int]) -> Path:
    """A folder of episodes: number -> timesteps."""
    for number, timesteps in lengths.items():
        write_episode(tmp_path / "files", number, timesteps)
    return tmp_path / "files"


def words(tmp_path: Path, *more: str) -> list[str]:
    options = ["--root", str(tmp_path / "data"), "--image-size", "16", "--workers", "1"]
    return [str(tmp_path / "files"), *options, *more]


def recording(tmp_path: Path, name: str = "demos") -> Path:
    return tmp_path / "data" / f"sketchy_{name}_16px"


def test_every_timestep_of_every_episode_in_order(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The grey level of an image tells episode, timestep and camera."""
    lengths = {number: 2 + number % 3 for number in range(10)}
    folder_of(tmp_path, lengths)
    main(words(tmp_path, "--windows", "full,c4"))
    assert "10 episodes with 29 timesteps, 0 skipped." in capsys.readouterr().out
    numbers = {"val": [0], "test": [1], "train": list(range(2, 10))}
    for split, expected in numbers.items():
        reader = Reader(recording(tmp_path), KIND, split)
        assert [one.name for one in episodes_of(reader.manifest.settings)[split]] == [episode_name(n) for n in expected]
        for camera, short in enumerate(("fl", "fr")):
            levels = [level(t, n, camera) for n in expected for t in range(lengths[n])]
            for window in ("full", "c4"):
                images = reader.array(f"{short}_{window}")
                assert images.shape == (len(levels), 16, 16, 3)
                assert images.dtype == np.uint8
                assert np.abs(images.astype(int) - np.array(levels)[:, None, None, None]).max() <= 1  # JPEG
    assert not (recording(tmp_path) / "train" / "fl_c0.npy").exists()


def test_the_same_command_again_reads_no_episode(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = folder_of(tmp_path, {0: 2, 1: 1})
    main(words(tmp_path, "--windows", "full"))
    assert "No episode for val and test" in capsys.readouterr().err
    monkeypatch.setattr(files, "check_episode", lambda path: pytest.fail(f"{path} was checked again"))
    main(words(tmp_path, "--windows", "full"))
    monkeypatch.undo()
    # other windows or episodes in the same place are refused, in a place of their own they are made
    for more in (["--windows", "full,c0"], ["--windows", "full"]):
        if more[-1] == "full":
            write_episode(folder, 5, 1)
        with pytest.raises(SystemExit) as ended:
            main(words(tmp_path, *more))
        assert ended.value.code == 1
        assert "holds other episodes or windows" in capsys.readouterr().err
    main(words(tmp_path, "--windows", "full", "--name", "more"))
    assert len(Reader(recording(tmp_path, "more"), KIND, "train")) == 4


def test_what_is_damaged_is_named_counted_and_keeps_its_place_in_the_split(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = folder_of(tmp_path, dict.fromkeys(range(10), 1))
    whole = (folder / episode_name(0)).read_bytes()
    damaged = {
        0: (whole[:-5], "it is cut off in record 0"),
        3: (b"", "it is empty"),
        7: (whole[:500] + bytes([whole[500] ^ 1]) + whole[501:], "the checksum of record 0 is wrong"),
    }
    for number, (content, _) in damaged.items():
        (folder / episode_name(number)).write_bytes(content)
    (folder / episode_name(5)).unlink()
    (folder / episode_name(5)).symlink_to(tmp_path / "missing")
    damaged[5] = (b"", "it cannot be read (No such file or directory)")
    main(words(tmp_path, "--windows", "full"))
    output = capsys.readouterr()
    for number, (_, sentence) in damaged.items():
        assert f"{episode_name(number)} is skipped: {sentence}." in output.err
    assert "6 episodes with 6 timesteps, 4 skipped." in output.out
    manifest = Reader(recording(tmp_path), KIND, "train").manifest
    assert [len(part) for part in episodes_of(manifest.settings).values()] == [5, 0, 1]  # val was episode 0
    assert manifest.facts["skipped"] == {episode_name(number): sentence for number, (_, sentence) in damaged.items()}
    # repaired by another download, it is checked again
    (folder / episode_name(0)).write_bytes(whole)
    with pytest.raises(SystemExit):
        main(words(tmp_path, "--windows", "full"))
    assert "7 episodes with 7 timesteps, 3 skipped." in capsys.readouterr().out


def test_a_python_without_filters_reads_no_archive(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(tarfile, "data_filter", raising=False)
    (tmp_path / "files").mkdir()
    tarfile.open(tmp_path / "files" / "a.tar.bz2", "w:bz2").close()
    with pytest.raises(SystemExit):
        main(words(tmp_path))
    assert "needs Python 3.11.4" in capsys.readouterr().err


@pytest.mark.skipif(not hasattr(tarfile, "data_filter"), reason="Python before 3.11.4 has no filter")
def test_archives_give_the_same_recording_as_their_episodes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = folder_of(tmp_path, dict.fromkeys(range(10), 1))
    main(words(tmp_path, "--windows", "full", "--name", "loose"))
    for part, numbers in enumerate((range(5), range(5, 10))):
        with tarfile.open(folder / f"lift_green__demos-{part:05d}-of-00002.tar.bz2", "w:bz2") as tar:
            for number in numbers:
                tar.add(folder / episode_name(number), episode_name(number))
    for number in range(10):
        (folder / episode_name(number)).unlink()
    main(words(tmp_path, "--windows", "full", "--name", "packed"))
    loose, packed = (Reader(recording(tmp_path, name), KIND, "train").manifest for name in ("loose", "packed"))
    assert loose.content == packed.content
    assert loose.fingerprint == packed.fingerprint
    (folder / "lift_green__demos-00001-of-00002.tar.bz2").unlink()
    with pytest.raises(SystemExit):
        main(words(tmp_path, "--windows", "full", "--name", "packed"))
    assert "lift_green__demos: 1 of 2 archives are missing (00001)" in capsys.readouterr().err


def test_a_damaged_recording_is_repaired(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder_of(tmp_path, {0: 3})
    main(words(tmp_path, "--windows", "full"))
    path = recording(tmp_path) / "train" / "fl_full.npy"
    whole = path.read_bytes()
    path.write_bytes(whole[:-100] + bytes(100))
    main(words(tmp_path, "--windows", "full", "--repair"))
    assert "repaired" in capsys.readouterr().out
    assert path.read_bytes() == whole
    main(words(tmp_path, "--windows", "full", "--repair"))
    assert "no damage found" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (["--windows", "full,c9"], "'c9' is none of full, c0"),
        (["--image-size", "8"], "'8' is no number from 16 to 352"),
        (["--workers", "0"], "'0' is no number from 1"),
        (["--name", "../x"], "is no name"),
    ],
)
def test_wrong_words_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], sentence: str
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words(tmp_path, *more))
    assert ended.value.code == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


def test_a_folder_without_a_sound_episode(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words(tmp_path))
    assert ended.value.code == 1
    assert "is not a folder" in capsys.readouterr().err
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / episode_name(0)).write_bytes(b"")
    with pytest.raises(SystemExit):
        main(words(tmp_path))
    assert "holds no sound episode (1 are damaged)" in capsys.readouterr().err


def test_help_says_how_to_get_the_data(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    subsets = {
        **{"lift_green__demos": 2, "stack_green_on_red__demos": 2, "lift_green__episodes": 70, "rgb30__all": 205},
        **{"stack_green_on_red__episodes": 101, "pull_cloth_up__episodes": 133, "deform8__all": 233},
        "episodes_with_rewards": 58,
    }
    lines = [line.split() for line in text.splitlines()]
    for subset, count in subsets.items():
        assert any(line[:2] == [subset, str(count)] and line[3] in ("GB", "TB") for line in lines if len(line) > 3)
    assert "storage.googleapis.com/sketchy-data" in text


def test_workers_need_no_pytorch() -> None:
    command = "import sys, apex_lab.data.sketchy.command; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", command]).returncode == 0


def test_sizes_of_a_recording_at_the_papers_scale() -> None:
    """What --help and docs/sketchy.md say."""
    several = {"train": [(0, 201)] * 320, "val": [(0, 201)] * 40, "test": [(0, 201)] * 40}
    from apex_lab.data.sketchy.recording import Episode

    parts = {split: [Episode(str(n), t) for n, t in some] for split, some in several.items()}
    windows = ("full", "c0", "c1", "c2", "c3", "c4", "c5")
    assert plan(parts, 128, windows).layout.total_bytes() == pytest.approx(55.3e9, rel=0.01)
    assert plan(parts, 128, ("full",)).layout.total_bytes() == pytest.approx(7.9e9, rel=0.01)


@pytest.mark.slow
def test_a_killed_preparation_is_resumed_and_ends_with_the_same_bytes(tmp_path: Path) -> None:
    folder_of(tmp_path, dict.fromkeys(range(10), 12))
    command = [sys.executable, "-m", "apex_lab.data.sketchy", *words(tmp_path)]
    command[command.index("--workers") + 1] = "2"
    kills = 0
    for sign in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT):
        journal = recording(tmp_path) / "timesteps.jsonl"
        before = journal.stat().st_size if journal.exists() else 0
        process = subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True)
        while process.poll() is None and (not journal.exists() or journal.stat().st_size <= before + 500):
            time.sleep(0.02)
        if process.poll() is None:
            os.kill(process.pid, sign)
            kills += 1
        _, errors = process.communicate(timeout=60)
        if sign != signal.SIGKILL:
            assert process.returncode == 128 + sign
            assert b"run the same command to resume" in errors
    assert kills == 3
    subprocess.run(command, check=True)
    resumed = Reader(recording(tmp_path), KIND, "train").manifest
    shutil.rmtree(tmp_path / "data")
    subprocess.run(command, check=True)
    unbroken = Reader(recording(tmp_path), KIND, "train").manifest
    assert resumed.content == unbroken.content
    assert resumed.records == unbroken.records
