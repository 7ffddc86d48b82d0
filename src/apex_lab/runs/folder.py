"""Run folders: named by what was run, one record each, found again by the same command.

    outputs/<model>[_<ablation>][_tuned_<study>]_<data>_<scale>_<hash>/seed_<n>/
        run.json        status (running | paused | finished | failed), reason, versions, hardware, ...
        config.yaml     resolved configuration
        metrics.json    results;  curves.csv  values during training;  log.txt  messages
        checkpoints/    last.ckpt, previous.ckpt, best.ckpt
        view/           film strips, movies, curves

The hash is a fingerprint of the resolved configuration without the seed and without what cannot change a result, so all
seeds of one configuration stand beside each other, and a changed configuration never meets an old result.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import torch
import yaml
from filelock import FileLock, Timeout

from apex_lab.base import console
from apex_lab.base.errors import Busy, UserError
from apex_lab.base.files import drafts, make_folder, read_json, set_aside, unwritable, write_json, write_text
from apex_lab.config.job import Job
from apex_lab.config.upgrades import FORMAT, fingerprint
from apex_lab.runs import identity, provenance
from apex_lab.runs.record import read_record
from apex_lab.runs.state import LOCK, RECORD, RESULTS, has_scores


def group_name(job: Job) -> str:
    """Name of the configuration, common to all its seeds."""
    return identity.group_name(fingerprint(job.raw), job.choices)


def run_folder(job: Job) -> Path:
    """Where a job's run lies: the folder of its name, or one of an older version with the same identity."""
    outputs = identity.Outputs(Path(job.config.paths.outputs))
    return identity.run_folder(outputs, fingerprint(job.raw), job.choices, job.config.seed)


Outcome = Literal["finished", "paused", "failed", "interrupted", "diverged", "pruned"]
"""How a run's last attempt ended; null in the record while it is running. Paused: `trainer.max_minutes` were over."""

KEPT = ("continues", "foreground_share", "history", "wandb_id")
"""Entries of the record that the checkpoint keeps too: what nothing else could bring back if run.json were lost."""


@dataclass
class Run:
    """A run folder that this process works in; use it as a context to hold its lock.

    Attributes:
        job: what is run.
        folder: where.
        record: content of run.json.
    """

    job: Job
    folder: Path
    record: dict[str, Any] = field(default_factory=dict)

    def __init__(self, job: Job) -> None:
        self.job = job
        self.folder = run_folder(job)
        self._lock = FileLock(str(self.folder / LOCK))
        self.record = {}
        self._lost = False

    def __enter__(self) -> Run:
        """Takes the run for this process and reads its record.

        Raises:
            Busy: another process has it.
            UserError: the folder cannot be written.
        """
        make_folder(self.folder)
        try:
            self._lock.acquire(blocking=False)
        except Timeout as error:
            raise Busy(f"{self.folder} is being worked on by another process: wait for it or stop it.") from error
        except OSError as error:
            raise unwritable(self.folder, error) from error
        if self.record_file.is_file():
            self._read()
        return self

    def _read(self) -> None:
        """Reads the record; a damaged one is set aside, since the checkpoint has what it held."""
        try:
            self.record = read_record(self.record_file)
        except UserError:
            aside = set_aside(self.record_file)
            console.warn(
                f"{self.record_file} is damaged and was set aside as {aside.name}: "
                "what it held is taken from the checkpoint."
            )

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    @property
    def record_file(self) -> Path:
        return self.folder / RECORD

    @property
    def metrics_file(self) -> Path:
        return self.folder / RESULTS

    @property
    def curves_file(self) -> Path:
        return self.folder / "curves.csv"

    @property
    def last(self) -> Path:
        return self.folder / "checkpoints" / "last.ckpt"

    @property
    def best(self) -> Path:
        return self.folder / "checkpoints" / "best.ckpt"

    @property
    def view_folder(self) -> Path:
        return self.folder / "view"

    @property
    def finished(self) -> bool:
        """Whether everything was done and its results are there and whole."""
        return self.record.get("status") == "finished" and has_scores(self.folder, self.job.config.evaluation.split)

    def start(self, command: str, device: torch.device) -> None:
        """Records that work begins or resumes, and with what."""
        make_folder(self.folder / "checkpoints")
        for place in (self.folder, *self._places()):
            for part in drafts(place):
                try:
                    part.unlink()  # left by a kill in the middle of writing
                except OSError as error:
                    raise unwritable(part, error) from error
        self._lost = not self.record
        commit, dirty = provenance.commit()
        now, choices, config = _now(), self.job.choices, self.job.config
        history = [*self.record.get("history", []), {"started": now, "command": command, "commit": commit}]
        self.record = {
            **self.record,
            "format": FORMAT,
            "status": "running",
            "outcome": None,
            "reason": None,
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "heartbeat": now,
            "started": history[0]["started"],
            "finished": None,
            "seconds": self.record.get("seconds", 0.0),  # of training, over all restarts
            "steps": self.record.get("steps", 0),
            "max_steps": config.trainer.max_steps,
            "history": history,
            "command": command,
            "overrides": list(self.job.overrides),
            **{group: choices.get(group) for group in ("model", "ablation", "data", "scale", "experiment", "tuned")},
            "seed": config.seed,
            "init_from": self.job.raw.get("init_from"),
            "fingerprint": fingerprint(self.job.raw),
            "data_fingerprint": self.record.get("data_fingerprint"),
            "commit": commit,
            "dirty": dirty,
            "versions": provenance.versions(),
            "hardware": provenance.hardware(device),
        }
        write_text(self.folder / "config.yaml", yaml.safe_dump(self.job.raw, sort_keys=False, allow_unicode=True))
        self.save()

    def _places(self) -> list[Path]:
        """Folders that training writes into; evaluations in folders of their own have locks of their own."""
        view = [path for path in self.view_folder.rglob("*") if path.is_dir()]
        return [self.folder / "checkpoints", self.view_folder, *view]

    def kept(self) -> dict[str, Any]:
        """What a checkpoint keeps of the record."""
        return {name: self.record[name] for name in KEPT if self.record.get(name) is not None}

    def restore(self, step: int, training: Mapping[str, Any] | None) -> None:
        """Takes back what a checkpoint knows and the record, if run.json was lost, does not.

        Args:
            step: of the checkpoint.
            training: its entry `training`.
        """
        training = training or {}
        kept = {**training.get("record", {}), "data_fingerprint": training.get("data_fingerprint")}
        before = kept.pop("history", [])
        if self._lost:
            self.record["history"] = [*before, *self.record["history"]]
            self.record["started"] = self.record["history"][0]["started"]
        if "foreground_share" not in kept:  # of an older version
            kept["foreground_share"] = self._share_of_results()
        self.record.update({name: value for name, value in kept.items() if self.record.get(name) is None})
        seconds = training.get("seconds", self.record["seconds"])
        self.update(steps=step, seconds=round(seconds, 1))

    def _share_of_results(self) -> float | None:
        try:
            share = read_json(self.metrics_file).get("validation_foreground_share")
        except UserError:
            return None
        return float(share) if isinstance(share, float | int) and 0 <= share <= 1 else None

    def update(self, **entries: Any) -> None:
        """Changes entries of the record."""
        self.record.update(entries)
        self.save()

    def beat(self, **entries: Any) -> None:
        """Changes entries of the record, and shows that the process is alive."""
        self.update(**entries, heartbeat=_now())

    def finish(self) -> None:
        """Records that everything is done."""
        self.update(status="finished", outcome="finished", reason=None, finished=_now())

    def pause(self, reason: str) -> None:
        """Records that time was up; the same command resumes from the last checkpoint."""
        self.update(status="paused", outcome="paused", reason=reason, finished=_now())

    def fail(self, reason: str, outcome: Outcome = "failed") -> None:
        """Records why work ended early; the same command resumes from the last checkpoint."""
        self.update(status="failed", outcome=outcome, reason=reason, finished=_now())

    def save(self) -> None:
        """Writes run.json."""
        write_json(self.record_file, self.record)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
