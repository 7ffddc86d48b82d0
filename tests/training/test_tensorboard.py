"""`logger=tensorboard`, and pictures during training: read back from event files by TensorBoard's own reader."""

from __future__ import annotations

import importlib.util
import io
import json
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader
from tensorboard.compat.proto.event_pb2 import Event

from apex_lab.training.event_files import PATTERN, cut
from tests.conftest import Ended
from tests.test_train import curves, start, wait_for_step, weights, without_speed

LONG = ("logger=tensorboard", "trainer.max_steps=12", "trainer.checkpoint_interval=3")


def events(run: Path) -> list[Event]:
    """Everything in the files, as it was written: nothing is purged by the reader."""
    files = sorted((run / "tensorboard").glob(PATTERN))
    return [Event.FromString(data) for file in files for data in RawEventFileLoader(str(file)).Load()]


def values(run: Path) -> list[tuple[str, int, Any]]:
    """(tag, step, number or encoded picture)."""
    found = []
    for event in events(run):
        for value in event.summary.value:
            kind = value.WhichOneof("value")
            content = {"image": value.image.encoded_image_string, "simple_value": value.simple_value}
            if kind in content:
                found.append((value.tag, event.step, content[kind]))
    return found


def numbers(run: Path) -> dict[tuple[str, int], float]:
    return {(tag, step): value for tag, step, value in values(run) if isinstance(value, float)}


def pictures(run: Path, tag: str) -> dict[int, Image.Image]:
    return {step: Image.open(io.BytesIO(value)) for name, step, value in values(run) if name == tag}


def check_complete(run: Path) -> None:
    """Every value of the curves and of the results is there, once."""
    counts = Counter((tag, step) for tag, step, _ in values(run))
    assert set(counts.values()) == {1}
    sent = numbers(run)
    rows = curves(run)
    expected = {(key, int(row["step"])): float(row[key]) for row in rows for key in row if key != "step" and row[key]}
    results = json.loads((run / "metrics.json").read_text())["splits"]["test"]["total"]
    last = int(rows[-1]["step"])
    expected |= {(f"test/{key}", last): float(v) for key, v in results.items() if isinstance(v, int | float)}
    assert sorted(sent) == sorted(expected)
    for place, value in expected.items():
        assert sent[place] == np.float32(value), place


@pytest.mark.parametrize("killed", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_run_that_goes_on_repeats_and_misses_nothing(
    killed: bool,
    train: Callable[..., Ended],
    the_run: Callable[..., Path],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    if killed:
        process = start(tmp_path, *LONG)
        run = wait_for_step(tmp_path, 6)
        process.kill()
        process.communicate()
    else:
        monkeypatch.setenv("TINY_BROKEN_AT", "8")
        assert train(*LONG).code == 1
        monkeypatch.delenv("TINY_BROKEN_AT")
        run = the_run()
        assert max(step for _, step, _ in values(run)) == 8  # beyond the checkpoint of step 6
        with open(next((run / "tensorboard").glob(PATTERN)), "ab") as file:
            file.write(b"half a record")
    ended = train(*LONG)
    assert ended.code == 0, ended.err
    assert "resuming from step" in ended.out
    check_complete(run)
    assert sorted(pictures(run, "val/pictures")) == [3, 6, 9, 12]
    [log_start] = [event for event in events(run) if event.HasField("session_log")]
    assert log_start.step == int(ended.out.split("resuming from step ")[1].split()[0]) + 1


def test_the_numbers_and_the_name_of_a_run_do_not_depend_on_it(train: Callable[..., Ended], trained: Path) -> None:
    shutil.move(trained, trained.with_name("plain"))
    ended = train("logger=tensorboard", "logger.tensorboard.pictures=1", "logger.tensorboard.pictures_every=2")
    assert ended.code == 0, ended.err
    check_complete(trained)
    plain = trained.with_name("plain")
    assert without_speed(trained) == without_speed(plain)
    ours, theirs = weights(trained), weights(plain)
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    [(step, picture)] = pictures(trained, "val/pictures").items()  # the second of two validations
    assert step == 6
    video = 5 * (128 + 4)  # five rows, ground truth among them
    assert picture.height - video < 0.5 * video
    assert not list(plain.glob("tensorboard"))


@pytest.mark.slow
def test_it_takes_up_a_run_that_began_without_it(
    train: Callable[..., Ended], the_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("trainer.max_steps=9", "trainer.checkpoint_interval=3", "evaluation.pictures=1")
    monkeypatch.setenv("TINY_BROKEN_AT", "7")
    assert train(*words).code == 1
    monkeypatch.delenv("TINY_BROKEN_AT")
    assert train(*words, "logger=tensorboard", "logger.tensorboard.pictures=0").code == 0
    run = the_run()
    check_complete(run)
    assert not pictures(run, "val/pictures")
    strip = next(value for tag, _, value in values(run) if tag == "test/film_strip")
    assert strip == (run / "view" / "film_strip.png").read_bytes()
    # the evaluation alone, once more
    (run / "metrics.json").unlink()
    assert train(*words, "logger=tensorboard").code == 0
    check_complete(run)


@pytest.mark.slow
def test_each_job_of_a_sweep_has_its_own_folder(train: Callable[..., Ended], tmp_path: Path) -> None:
    assert train("logger=tensorboard", "seed=0,1", "-m").code == 0
    runs = sorted(tmp_path.glob("outputs/*/seed_*"))
    assert len(runs) == 2
    for run in runs:
        check_complete(run)


@pytest.mark.slow
def test_a_model_that_does_not_train_shows_its_scores(
    train: Callable[..., Ended], the_run: Callable[..., Path]
) -> None:
    assert train("model=one_segment", "logger=tensorboard").code == 0
    assert ("test/ari", 0) in numbers(the_run())


def test_without_its_package_nothing_is_started(
    train: Callable[..., Ended], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    there = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == "tensorboard" else there(name, *a)
    )
    ended = train("logger=tensorboard")
    assert ended.code == 2
    assert ended.err.splitlines() == [
        "logger.tensorboard needs a package that is not installed: pip install 'apex-lab[tensorboard]'."
    ]
    assert not (tmp_path / "outputs").exists()


def test_event_files_are_cut_at_a_step(tmp_path: Path) -> None:
    from torch.utils.tensorboard import SummaryWriter

    assert cut(tmp_path / "none", 3) == set()
    for first in (1, 4):
        with SummaryWriter(str(tmp_path)) as writer:
            for step in range(first, first + 3):
                writer.add_scalar("a", float(step), step)
    assert cut(tmp_path, 9) == {("a", step) for step in range(1, 7)}
    [_, second] = sorted(tmp_path.glob(PATTERN), key=lambda file: int(file.name.rpartition(".")[2]))
    size = second.stat().st_size
    with open(second, "r+b") as file:
        file.truncate(size - 1)  # the last record is not whole
    assert cut(tmp_path, 9) == {("a", step) for step in range(1, 6)}
    assert cut(tmp_path, 2) == {("a", 1), ("a", 2)}
    assert cut(tmp_path, 2) == {("a", 1), ("a", 2)}
