"""The cache of derived files: made once and atomically, by one of many processes."""

from __future__ import annotations

import importlib.metadata
import multiprocessing
import sys
import time
from pathlib import Path

import pytest

from sims import bullet, cache
from sims.errors import SimError

pytest.importorskip("pybullet")


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("APEX_LAB_CACHE", str(tmp_path / "cache"))


def _slow_make(folder: Path) -> None:
    (folder / "first").write_text("1")
    time.sleep(0.3)
    (folder / "second").write_text("2")


def _ask(log: str) -> None:
    def make(folder: Path) -> None:
        with Path(log).open("a") as lines:
            lines.write("made\n")
        _slow_make(folder)

    made = cache.made_once("thing", {"a": 1}, make)
    assert (made / "first").read_text() == "1"
    assert (made / "second").read_text() == "2"


def test_many_processes_make_it_once(tmp_path: Path) -> None:
    log = tmp_path / "log"
    context = multiprocessing.get_context("fork")
    processes = [context.Process(target=_ask, args=(str(log),)) for _ in range(4)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0] * 4
    assert log.read_text() == "made\n"


def test_a_failure_leaves_nothing_behind() -> None:
    def fail(folder: Path) -> None:
        (folder / "first").write_text("1")
        raise RuntimeError("broken")

    with pytest.raises(RuntimeError, match="broken"):
        cache.made_once("thing", {}, fail)
    assert not [path for path in (cache.cache_folder() / "models").iterdir() if path.is_dir()]
    assert (cache.made_once("thing", {}, _slow_make) / "second").is_file()


def test_a_cache_that_cannot_be_written_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file" / "cache", Path("/proc/cache")):
        monkeypatch.setenv("APEX_LAB_CACHE", str(place))
        with pytest.raises(
            SimError, match=rf"the cache at {place} cannot be written .*: set APEX_LAB_CACHE to a folder"
        ):
            cache.made_once("thing", {}, _slow_make)


@pytest.mark.parametrize("damage", ["flipped", "cut", "deleted", "unsealed"])
def test_damaged_files_are_made_again(damage: str) -> None:
    folder = cache.made_once("thing", {}, _slow_make)
    if damage == "flipped":
        (folder / "second").write_text("3")
    elif damage == "cut":
        (folder / "second").write_text("")
    else:
        (folder / ("second" if damage == "deleted" else cache.CHECKSUMS)).unlink()
    assert cache.made_once("thing", {}, _slow_make) == folder
    assert (folder / "second").read_text() == "2"
    before = (folder / "second").stat().st_mtime_ns
    cache.made_once("thing", {}, _slow_make)
    assert (folder / "second").stat().st_mtime_ns == before


def test_another_recipe_is_another_folder() -> None:
    assert cache.made_once("thing", {"a": 1}, _slow_make) != cache.made_once("thing", {"a": 2}, _slow_make)


def test_a_missing_pybullet_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(SimError, match=r"PyBullet is not installed: run `pip install pybullet`"):
        bullet.load_pybullet()
    with pytest.raises(SimError, match="PyBullet is not installed"):
        cache.versions()


@pytest.mark.parametrize(
    ("provided_by", "recorded"),
    [
        (["pybullet"], "3.2.7"),
        (["pybullet-arm64"], "3.2.8 (pybullet-arm64)"),
        (["pybullet-arm64", "pybullet"], "3.2.7 + 3.2.8 (pybullet-arm64)"),
        ([], "without metadata"),
    ],
)
def test_any_distribution_of_pybullet_is_recorded(
    provided_by: list[str], recorded: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    versions = {"pybullet": "3.2.7", "pybullet-arm64": "3.2.8"}
    monkeypatch.setattr(importlib.metadata, "packages_distributions", lambda: {"pybullet": provided_by})
    monkeypatch.setattr(importlib.metadata, "version", lambda name: versions.get(name, "1.0"))
    bullet.pybullet_version.cache_clear()
    try:
        assert cache.versions()["pybullet"] == recorded
    finally:
        bullet.pybullet_version.cache_clear()
