from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch

from apex_lab.config.job import Job
from apex_lab.config.upgrades import EXCLUDED, fingerprint
from apex_lab.runs.folder import Run, group_name, run_folder
from tests.conftest import compose_job


@pytest.fixture
def job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Job:
    monkeypatch.chdir(tmp_path)
    return compose_job("seed=3")


def changed(raw: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    raw = deepcopy(raw)
    *path, last = key.split(".")
    part = raw
    for name in path:
        part[name] = dict(part.get(name) or {})
        part = part[name]
    part[last] = value
    return raw


@pytest.mark.parametrize("key", EXCLUDED)
def test_excluded_keys_keep_the_fingerprint(key: str, job: Job) -> None:
    assert fingerprint(changed(job.raw, key, "else")) == fingerprint(job.raw)


@pytest.mark.parametrize(
    "key",
    [
        "trainer.max_steps",
        "trainer.precision",
        "data.frames",
        "clips.batch_size",
        "model.components",
        "optimizer.lr",
        "loss.error",
    ],
)
def test_all_others_change_it(key: str, job: Job) -> None:
    assert fingerprint(changed(job.raw, key, 77)) != fingerprint(job.raw)


def test_the_order_of_keys_does_not_matter(job: Job) -> None:
    assert fingerprint(dict(reversed(job.raw.items()))) == fingerprint(job.raw)


def test_folders_are_named_by_what_was_run(job: Job) -> None:
    digest = fingerprint(job.raw)[:8]
    assert run_folder(job) == Path("outputs") / f"tiny_squares_smoke_{digest}" / "seed_3"
    ablated = Job(job.config, job.raw, {**job.choices, "ablation": "no_entropy"})
    assert group_name(ablated) == f"tiny_no_entropy_squares_smoke_{digest}"


def test_a_record_goes_from_running_to_its_end(job: Job) -> None:
    with Run(job) as run:
        assert run.record == {}
        run.start("python -m apex_lab.train", torch.device("cpu"))
    with Run(job) as run:
        assert run.record["status"] == "running"
        started = run.record["started"]
        run.update(steps=4, seconds=2.5)
        run.fail("the reason")
        assert (run.record["status"], run.record["reason"]) == ("failed", "the reason")
        run.start("python -m apex_lab.train", torch.device("cpu"))
        assert (run.record["status"], run.record["reason"]) == ("running", None)
        assert (run.record["started"], run.record["steps"], run.record["seconds"]) == (started, 4, 2.5)
        assert run.record["history"][0]["started"] == started
        assert len(run.record["history"]) == 2
        run.finish()
        assert not run.finished  # no results yet
        run.metrics_file.write_text("{}")
        assert not run.finished
        run.metrics_file.write_text('{"splits": {"test": {"total": {}}}}')
        assert run.finished
        run.pause("time is up")
        assert (run.record["status"], run.record["outcome"]) == ("paused", "paused")
        assert not run.finished


def test_what_a_kill_left_half_written_is_removed(job: Job) -> None:
    with Run(job) as run:
        run.start("", torch.device("cpu"))
        folders = [run.folder, run.folder / "checkpoints", run.folder / "view" / "test", run.folder / "evaluate" / "x"]
        ours = [folder / ".last.ckpt.123.apex_lab.part" for folder in folders]
        theirs = [folder / name for folder in folders for name in (".mine.part", ".last.ckpt.123.part", "a.part")]
        for file in ours + theirs:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text("half")
        run.start("", torch.device("cpu"))
        assert [file.exists() for file in ours] == [False, False, False, True]  # an evaluation has a lock of its own
        assert all(file.exists() for file in theirs)
