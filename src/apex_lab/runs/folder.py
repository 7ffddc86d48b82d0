"""Run folders: named by what was run, one record each, found again by the same command.

    outputs/<model>[_<ablation>]_<data>_<scale>_<hash>/seed_<n>/
        run.json        status (running | finished | failed), reason, versions, hardware, ...
        config.yaml     resolved configuration
        metrics.json    results;  curves.csv  what happened on the way;  log.txt  what was said
        checkpoints/    last.ckpt, previous.ckpt, best.ckpt
        view/           pictures

The hash is a fingerprint of the resolved configuration without the seed and without what cannot change a result, so all
seeds of one configuration stand beside each other, and a changed configuration never meets an old result.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
import yaml
from filelock import FileLock, Timeout

from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, read_json, write_json, write_text
from apex_lab.config.schema import Job
from apex_lab.runs import provenance

HARMLESS = (
    "seed",
    "paths",
    "logger",
    "callbacks.progress",
    "data.root",
    "data.seed",
    "data.workers",
    "data.generate",
    "data.sim_workers",
    "data.verify",
    "trainer.accelerator",
    "trainer.log_interval",
    "trainer.checkpoint_interval",
    "evaluation.pictures",
)
"""Keys that do not belong to a run's fingerprint: a run goes on, or is finished, whatever they say."""


def fingerprint(config: Mapping[str, Any]) -> str:
    """Hexadecimal digest of a resolved configuration without its harmless keys."""
    content = deepcopy(dict(config))
    for key in HARMLESS:
        group, _, name = key.partition(".")
        (content.get(group) or {} if name else content).pop(name or group, None)
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def group_name(job: Job) -> str:
    """Name of the configuration, common to all its seeds."""
    words = [job.choices.get(group) for group in ("model", "ablation", "data", "scale")]
    return "_".join([word for word in words if word] + [fingerprint(job.raw)[:8]])


def run_folder(job: Job) -> Path:
    """Where a job's run lies."""
    return Path(job.config.paths.outputs) / group_name(job) / f"seed_{job.config.seed}"


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
        self._lock = FileLock(str(self.folder / ".lock"))
        self.record = {}

    def __enter__(self) -> Run:
        """Takes the run for this process and reads its record.

        Raises:
            UserError: another process has it, or the folder cannot be written.
        """
        make_folder(self.folder)
        try:
            self._lock.acquire(blocking=False)
        except Timeout as error:
            raise UserError(f"{self.folder} is being worked on by another process: wait for it or stop it.") from error
        except OSError as error:
            raise UserError(
                f"{self.folder} cannot be written ({error.strerror}): choose another paths.outputs."
            ) from error
        if self.record_file.is_file():
            self.record = read_json(self.record_file)
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    @property
    def record_file(self) -> Path:
        return self.folder / "run.json"

    @property
    def metrics_file(self) -> Path:
        return self.folder / "metrics.json"

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
        """Whether everything was done and its results are there."""
        return self.record.get("status") == "finished" and self.metrics_file.is_file()

    def start(self, command: str, device: torch.device) -> None:
        """Records that work begins (or goes on) and with what."""
        make_folder(self.folder / "checkpoints")
        for part in self.folder.rglob(".*.part"):
            part.unlink()  # left by a kill in the middle of writing
        commit, dirty = provenance.commit()
        now, choices, config = _now(), self.job.choices, self.job.config
        history = [*self.record.get("history", []), {"started": now, "command": command, "commit": commit}]
        self.record = {
            **self.record,
            "status": "running",
            "reason": None,
            "started": history[0]["started"],
            "finished": None,
            "seconds": self.record.get("seconds", 0.0),  # of training, over all restarts
            "steps": self.record.get("steps", 0),
            "history": history,
            "command": command,
            "overrides": list(self.job.overrides),
            **{group: choices.get(group) for group in ("model", "ablation", "data", "scale", "experiment")},
            "seed": config.seed,
            "fingerprint": fingerprint(self.job.raw),
            "data_fingerprint": self.record.get("data_fingerprint"),
            "commit": commit,
            "dirty": dirty,
            "versions": provenance.versions(),
            "hardware": provenance.hardware(device),
        }
        write_text(self.folder / "config.yaml", yaml.safe_dump(self.job.raw, sort_keys=False, allow_unicode=True))
        self.save()

    def update(self, **entries: Any) -> None:
        """Changes entries of the record."""
        self.record.update(entries)
        self.save()

    def finish(self) -> None:
        """Records that everything is done."""
        self.update(status="finished", reason=None, finished=_now())

    def fail(self, reason: str) -> None:
        """Records why work ended early; the same command goes on from the last checkpoint."""
        self.update(status="failed", reason=reason, finished=_now())

    def save(self) -> None:
        """Writes run.json."""
        write_json(self.record_file, self.record)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
