"""Files of runs with anything in them: every reader gives a state or a sentence, never a traceback."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from apex_lab.base.errors import UserError
from apex_lab.runs import checkpoints
from apex_lab.runs.progress import found
from apex_lab.runs.record import read_record
from apex_lab.runs.state import has_scores, is_whole, read_state
from apex_lab.tables.found import read_run
from apex_lab.training.loggers import Curves
from apex_lab.view.curves import read_curves
from tests.conftest import Ended
from tests.runs.test_checkpoints import content

RECORDS: dict[str, Any] = {
    "seconds": {"seconds": 10**400},
    "not a number": {"seconds": float("nan")},
    "steps": {"steps": True},
    "long steps": {"steps": 10**30},
    "negative steps": {"max_steps": -1},
    "pid": {"pid": 10**30},
    "history": {"history": ["yesterday"]},
    "heartbeat": {"heartbeat": 3},
    "overrides": {"overrides": {"seed": 1}},
    "format": {"format": [1]},
    "reason": {"reason": {}},
}


@pytest.mark.parametrize("case", RECORDS)
def test_a_record_with_wrong_types_is_damaged(case: str, tmp_path: Path) -> None:
    run = tmp_path / "tiny_0" / "seed_0"
    run.mkdir(parents=True)
    (run / "run.json").write_text(json.dumps({"status": "running", "seed": 0, **RECORDS[case]}))
    (name,) = RECORDS[case]
    with pytest.raises(UserError, match=rf"run\.json is damaged: {name}"):
        read_record(run / "run.json")
    assert read_state(run).state == "damaged"
    [job] = found(tmp_path).jobs
    assert job.state.state == "damaged"
    assert read_run(run, 0).state == "damaged"


@pytest.mark.parametrize("text", [b"\xff\xfe", b"[" * 100_000, b"1" * 5000, b'{"status": "\xe9"}', b"null"])
def test_a_record_that_is_no_json(text: bytes, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_bytes(text)
    with pytest.raises(UserError, match=r"run\.json"):
        read_record(tmp_path / "run.json")
    assert read_state(tmp_path).state == "damaged"


@pytest.mark.parametrize("year", ["0001-01-01T00:00:00", "9999-12-31T23:59:59+00:00", "soon"])
def test_times_that_no_clock_has(year: str, tmp_path: Path) -> None:
    run = tmp_path / "tiny_0" / "seed_0"
    run.mkdir(parents=True)
    record = {"status": "running", "heartbeat": year, "steps": 3, "max_steps": 9, "seconds": 2.0, "started": year}
    (run / "run.json").write_text(json.dumps(record))
    (run / "curves.csv").write_text(f"step,train/loss\n{'9' * 5000},1\n")
    [job] = found(tmp_path).jobs
    assert job.steps == 3


@pytest.mark.parametrize("total", [{"ari": "high"}, {"ari": [0.5]}, {"ari": {}}, [], "all", None])
def test_scores_that_are_no_numbers(total: Any, tmp_path: Path) -> None:
    scored = {"total": total}
    (tmp_path / "metrics.json").write_text(json.dumps({"splits": {"test": scored}}))
    assert not has_scores(tmp_path, "test")
    assert not is_whole(scored)
    assert is_whole({"total": {"ari": 0.5, "videos": 2, "hota": None}, "per_video": "anything"})


@pytest.mark.parametrize("text", [b"step,loss\n" + b"9" * 5000 + b",1\n3,2\n", "step,loss\n٣,1\n3,2\n".encode()])
def test_steps_that_are_no_numbers(text: bytes, tmp_path: Path) -> None:
    (tmp_path / "curves.csv").write_bytes(text)
    assert list(read_curves(tmp_path / "curves.csv").index) == [3]
    assert [row["step"] for row in Curves(tmp_path / "curves.csv", 5).rows] == ["3"]


ENTRIES: dict[str, Callable[[dict[str, Any]], object]] = {
    "step": lambda c: c.update(step="3"),
    "step ": lambda c: c.update(step=-1),
    "step  ": lambda c: c.update(step=10**30),
    "choices.model": lambda c: c.update(choices={"model": 3}),
    "training": lambda c: c.update(training=3),
    "training.optimizer": lambda c: c["training"].update(optimizer=[]),
    "training.seconds": lambda c: c["training"].update(seconds="long"),
    "training.best": lambda c: c["training"].update(best="x"),
    "training.callbacks": lambda c: c["training"].update(callbacks=3),
    "training.record": lambda c: c["training"].update(record=3),
    "training.record.history": lambda c: c["training"].update(record={"history": 3}),
    "inference.schedule": lambda c: c["inference"].update(schedule=3),
    "inference.schedule.noise": lambda c: c["inference"].update(schedule={"noise": "x"}),
    "inference.precision": lambda c: c["inference"].update(precision=[]),
    "inference.seed": lambda c: c["inference"].update(seed=-1),
    "inference.weights": lambda c: c["inference"].update(weights=[]),
}


@pytest.mark.parametrize("entry", ENTRIES)
def test_a_checkpoint_with_wrong_types_inside(entry: str, tmp_path: Path) -> None:
    path, made = tmp_path / "last.ckpt", content()
    ENTRIES[entry](made)
    checkpoints.save(path, made)
    for read in (checkpoints.load, checkpoints.glance):
        with pytest.raises(UserError, match=rf"is no apex_lab checkpoint \(its {entry.strip()} is none\)"):
            read(path)


def test_a_checkpoint_that_would_fill_the_memory(tmp_path: Path) -> None:
    path, made = tmp_path / "last.ckpt", content()
    made["inference"]["weights"]["layer.weight"] = torch.zeros(1).expand(10**6, 10**7)
    checkpoints.save(path, made)
    assert path.stat().st_size < 10_000
    with pytest.raises(UserError, match="is damaged or no checkpoint"):
        checkpoints.load(path)


@pytest.mark.parametrize("format", [True, "2", [2], 2.0])
def test_formats_that_are_no_numbers(format: Any, tmp_path: Path) -> None:
    path = tmp_path / "last.ckpt"
    torch.save({**content(), "format": format}, path)
    with pytest.raises(UserError, match=r"has format (true|'2'|\[2\]|2\.0), this version of apex_lab reads 1, 2"):
        checkpoints.load(path)


def test_a_state_that_fits_no_optimiser(
    train: Callable[..., Ended], the_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TINY_BROKEN_AT", "5")
    assert train().code == 1
    monkeypatch.delenv("TINY_BROKEN_AT")
    for path in (the_run() / "checkpoints").glob("*.ckpt"):
        made = torch.load(path, weights_only=True)
        if made["training"] is not None:
            made["training"]["optimizer"] = {"state": 3, "param_groups": "x"}
            torch.save(made, path)
    ended = train()
    assert ended.code == 1
    assert "The run's checkpoint does not fit its configuration (the state of the optimizer:" in ended.err
    assert "Traceback" not in ended.err
