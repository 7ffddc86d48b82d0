"""Making a folder: the same bytes by any number of workers, in any order, after any kill; clear errors otherwise."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from recordings import MANIFEST, verify
from sims.errors import SimError
from sims.p2d.generate import generate
from sims.p2d.store import KIND, layout, read_manifest
from tests.fakes.p2d_tools import REPOSITORY, children, content, make, small, start, words

linux = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    root = tmp_path_factory.mktemp("unbroken")
    make(root)
    return content(root)


@pytest.mark.parametrize(
    "workers", [3, pytest.param(2, marks=pytest.mark.slow), pytest.param(9, marks=pytest.mark.slow)]
)
def test_same_bytes_by_any_number_of_workers(tmp_path: Path, unbroken: dict[str, bytes], workers: int):
    make(tmp_path, workers=workers)
    assert content(tmp_path) == unbroken


def test_workers_are_replaced_after_some_trajectories(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    log = tmp_path / "log"
    log.mkdir()
    monkeypatch.setenv("FAKE_LOG", str(log))
    make(tmp_path / "data", recycle=5)
    by_process = Counter(path.name.split("-")[2] for path in log.iterdir())
    assert sorted(by_process.values()) == [2, 5, 5]


@linux
@pytest.mark.parametrize(
    "rounds", [pytest.param(3), pytest.param(40, marks=[pytest.mark.slow, pytest.mark.timeout(600)])]
)
def test_same_bytes_after_kills_at_random_moments(tmp_path: Path, rounds: int):
    rng = random.Random(rounds)
    settings = small(train=4 * rounds)
    make(tmp_path / "unbroken", settings)
    root = tmp_path / "data"
    command = ("--out", root, *words(settings), "--workers", 2, "--no-card")
    for _ in range(rounds):
        process = start(*command, FAKE_SLEEP_S=0.2)
        if rng.random() < 0.7:  # some kills find it starting, most find it working
            _wait_for_lines(root / KIND.journal, _lines(root / KIND.journal) + 2, process)
        time.sleep(rng.uniform(0, 0.3))
        victims = children(process.pid)
        process.kill()
        process.communicate()
        _wait_until_gone(victims)
        assert not (root / MANIFEST).exists()
    process = start(*command)
    assert process.wait(timeout=120) == 0
    assert content(root) == content(tmp_path / "unbroken")


@linux
def test_same_bytes_when_only_workers_are_killed(tmp_path: Path, unbroken: dict[str, bytes]):
    rng = random.Random(1)
    process = start("--out", tmp_path, *words(small()), "--workers", 2, "--no-card", FAKE_SLEEP_S=0.3)
    for lines in (2, 5, 8):  # between kills a trajectory was finished, so no trajectory reaches the limit of attempts
        _wait_for_lines(tmp_path / KIND.journal, lines, process)
        time.sleep(rng.uniform(0, 0.2))
        os.kill(rng.choice(children(process.pid)), signal.SIGKILL)
    _, text = process.communicate(timeout=120)
    assert process.returncode == 0, text
    assert content(tmp_path) == unbroken


def test_a_trajectory_whose_worker_died_is_retried(
    tmp_path: Path, unbroken: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
):
    marks = tmp_path / "marks"
    marks.mkdir()
    monkeypatch.setenv("FAKE_KILL_ONCE", str(marks))
    make(tmp_path / "data", workers=2)
    assert len(list(marks.iterdir())) == 6
    assert content(tmp_path / "data") == unbroken


def test_a_trajectory_that_always_kills_its_worker_ends_with_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("FAKE_KILL", "train-5")
    with pytest.raises(SimError, match=r"died 3 times while making trajectory train/5 \(killed, .*fewer workers"):
        make(tmp_path, workers=2)


def test_an_exception_in_a_worker_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("FAKE_RAISE", "val-1")
    with pytest.raises(SimError, match=r"val/1 \(exit code 1\): RuntimeError: the fake fell over"):
        make(tmp_path)


def test_an_error_of_the_simulator_is_reported_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("FAKE_REFUSE", "train-0")
    with pytest.raises(SimError, match=r"^the fake does not like this one$"):
        make(tmp_path)


def test_a_missing_simulator_is_reported(tmp_path: Path):
    with pytest.raises(SimError, match="package 'no_such_engine' is not installed"):
        generate(tmp_path, small(), simulator="no_such_engine", workers=1)


def test_after_an_error_the_next_start_generates_only_the_rest(
    tmp_path: Path, unbroken: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
):
    log = tmp_path / "log"
    log.mkdir()
    with monkeypatch.context() as patch:
        patch.setenv("FAKE_REFUSE", "train-6")
        with pytest.raises(SimError):
            make(tmp_path / "data")
    with pytest.raises(SimError, match=r"is not finished \(6 of 12 trajectories made\): resume with python -m"):
        read_manifest(tmp_path / "data")
    monkeypatch.setenv("FAKE_LOG", str(log))
    make(tmp_path / "data")
    assert len(list(log.iterdir())) == 6
    assert content(tmp_path / "data") == unbroken


def test_half_written_records_and_data_are_generated_again(
    tmp_path: Path, unbroken: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
):
    with monkeypatch.context() as patch:
        patch.setenv("FAKE_REFUSE", "train-6")
        with pytest.raises(SimError):
            make(tmp_path)
    journal = tmp_path / KIND.journal
    journal.write_bytes(journal.read_bytes()[:-20])  # a partial last line
    with open(tmp_path / "train" / "rgb.npy", "r+b") as file:  # power cut: a recorded trajectory never reached the disk
        file.seek(128 + 2 * 3 * 16 * 16 * 3)
        file.write(bytes(100))
    make(tmp_path)
    assert content(tmp_path) == unbroken


def test_finished_data_are_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    make(tmp_path)
    monkeypatch.setenv("FAKE_KILL", "train-0")
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npy")}
    make(tmp_path)
    assert times == {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npy")}


def test_a_lost_manifest_is_written_again_without_simulating(
    tmp_path: Path, unbroken: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
):
    make(tmp_path)
    (tmp_path / MANIFEST).unlink()
    monkeypatch.setenv("FAKE_KILL", "train-0")
    make(tmp_path)
    assert content(tmp_path) == unbroken


def test_other_settings_do_not_mix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    make(tmp_path / "whole")
    with pytest.raises(SimError, match=r"holds data with other settings \(seed is 0 there and 1 here\)"):
        make(tmp_path / "whole", small(seed=1))
    monkeypatch.setenv("FAKE_REFUSE", "train-6")
    with pytest.raises(SimError):
        make(tmp_path / "part")
    with pytest.raises(SimError, match=r"was started with other settings \(frames is 3 there and 4 here\)"):
        make(tmp_path / "part", small(frames=4))


def test_other_versions_do_not_mix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with monkeypatch.context() as patch:
        patch.setenv("FAKE_REFUSE", "train-6")
        with pytest.raises(SimError):
            make(tmp_path)
    monkeypatch.setenv("FAKE_VERSION", "2")
    with pytest.raises(SimError, match="was started with fake 1 and here is fake 2"):
        make(tmp_path)


def test_a_folder_with_other_content_is_left_alone(tmp_path: Path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(SimError, match=r"contains files that are not P2D \(thesis.tex\)"):
        make(tmp_path)
    with pytest.raises(SimError, match="cannot be used as a folder"):
        make(tmp_path / "thesis.tex")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_two_processes_generate_every_trajectory_once(tmp_path: Path, unbroken: dict[str, bytes]):
    log = tmp_path / "log"
    log.mkdir()
    both = [
        start("--out", tmp_path / "data", *words(small()), "--workers", 1, "--no-card", FAKE_LOG=log, FAKE_SLEEP_S=0.1)
        for _ in range(2)
    ]
    texts = [process.communicate(timeout=120)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], texts
    assert sum("waiting for another process that works on" in text for text in texts) == 1
    assert len(list(log.iterdir())) == 12
    assert content(tmp_path / "data") == unbroken


@linux
@pytest.mark.parametrize(
    ("number", "code", "word"),
    [(signal.SIGINT, 130, "interrupted"), pytest.param(signal.SIGTERM, 143, "terminated", marks=pytest.mark.slow)],
)
def test_a_stop_ends_cleanly_and_the_same_command_resumes(
    tmp_path: Path, unbroken: dict[str, bytes], number: int, code: int, word: str
):
    command = ("--out", tmp_path, *words(small()), "--workers", 2, "--no-card")
    process = start(*command, FAKE_SLEEP_S=0.3)
    _wait_for_lines(tmp_path / KIND.journal, 3, process)
    workers = children(process.pid)
    os.killpg(process.pid, number)
    _, text = process.communicate(timeout=120)
    assert process.returncode == code
    assert "Traceback" not in text
    assert f"{word}; finished trajectories are kept, run the same command to resume" in text
    assert workers
    _wait_until_gone(workers)
    again = start(*command)
    assert again.wait(timeout=120) == 0
    assert content(tmp_path) == unbroken


@linux
def test_workers_do_not_outlive_a_killed_parent(tmp_path: Path):
    process = start("--out", tmp_path, *words(small()), "--workers", 2, "--no-card", FAKE_SLEEP_S=0.3)
    _wait_for_lines(tmp_path / KIND.journal, 2, process)
    workers = children(process.pid)
    process.kill()
    process.wait()
    assert len(workers) == 2
    _wait_until_gone(workers)


def test_too_little_space_is_found_before_the_start(tmp_path: Path):
    huge = small(train=10_000_000, frames=1000, image_size=1024)
    with pytest.raises(SimError, match=r"P2D needs \d+.\d+ GB more at .* but only \d+.\d+ (GB|MB) are free there"):
        make(tmp_path, huge)
    assert not list(tmp_path.glob("*/*.npy"))


LIMITED = """
import resource, sys
from pathlib import Path
resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
from recordings import MANIFEST, verify
from sims.errors import SimError
from tests.fakes.p2d_tools import make
try:
    make(Path(sys.argv[1]))
except SimError as error:
    sys.exit(str(error))
"""


def test_a_file_that_cannot_grow_is_reported_and_leaves_nothing(tmp_path: Path):
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(tmp_path)], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr.startswith(f"writing {tmp_path}/train/rgb.npy failed (File too large; ")
    assert "free there): free space on that disk" in done.stderr
    assert not list(tmp_path.glob("*/*.npy"))


@pytest.fixture
def small_disk(tmp_path: Path):
    """A real file system of 3 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = os.geteuid() == 0 and shutil.which("mount") is not None
    if mounted:
        command = ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(folder)]
        mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    if not mounted:
        pytest.skip("may not mount a file system here")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def test_a_disk_filled_by_others_stops_the_work_and_keeps_finished_trajectories(
    small_disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    settings = small(train=60)
    make(tmp_path / "unbroken", settings)
    root = small_disk / "data"
    with monkeypatch.context() as patch:
        # Without reserved space, as on file systems that cannot reserve.
        patch.delattr(os, "posix_fallocate")
        patch.setenv("FAKE_FILL", str(small_disk))
        with pytest.raises(
            SimError, match=r"failed \(No space left on device; .* free there\): free space on that disk and run the"
        ):
            make(root, settings)
    made = len((root / KIND.journal).read_bytes().splitlines()) - 1
    assert 0 < made < len(layout(settings).all_keys())
    (small_disk / "other_peoples_file").unlink()
    make(root, settings)
    assert content(root) == content(tmp_path / "unbroken")


def test_reserved_space_lasts_when_others_fill_the_disk(small_disk: Path, monkeypatch: pytest.MonkeyPatch):
    root = small_disk / "data"
    monkeypatch.setenv("FAKE_FILL", str(small_disk))
    with pytest.raises(SimError, match="No space left on device"):  # for the small files at the end, not for the data
        make(root)
    assert len((root / KIND.journal).read_bytes().splitlines()) == 1 + len(layout(small()).all_keys())
    (small_disk / "other_peoples_file").unlink()
    monkeypatch.setenv("FAKE_KILL", "train-0")
    assert not verify(root, make(root))


def _lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


def _wait_for_lines(path: Path, count: int, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 60
    while _lines(path) < count:
        assert process.poll() is None, "it ended early"
        assert time.monotonic() < deadline, f"{path} never had {count} lines"
        time.sleep(0.02)


def _wait_until_gone(pids: list[int]) -> None:
    deadline = time.monotonic() + 60
    while any(_alive(pid) for pid in pids):
        assert time.monotonic() < deadline, f"a process of {pids} lives on"
        time.sleep(0.02)


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False
