"""Run folders: named by what was run, one record each, found again by the same command.

    outputs/<model>[_<ablation>][_tuned_<study>]_<data>_<scale>_<hash>/seed_<n>/
        run.json        status (running | finished | failed), reason, versions, hardware, ...
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
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import torch
import yaml
from filelock import FileLock, Timeout

from apex_lab.base.errors import Busy, UserError
from apex_lab.base.files import make_folder, read_json, write_json, write_text
from apex_lab.config.schema import Job
from apex_lab.config.upgrades import FORMAT, fingerprint, upgraded
from apex_lab.runs import provenance
from apex_lab.runs.state import LOCK, RECORD


def group_name(job: Job) -> str:
    """Name of the configuration, common to all its seeds."""
    return f"{_words(job)}_{fingerprint(job.raw)[:8]}"


def run_folder(job: Job) -> Path:
    """Where a job's run lies: the folder of its name, or one of an older version with the same identity."""
    outputs, seed = Path(job.config.paths.outputs), f"seed_{job.config.seed}"
    named = outputs / group_name(job) / seed
    if not named.exists():
        for older in sorted(outputs.glob(f"{_words(job)}_*/{seed}/{RECORD}")):
            if _same_run(older.parent, job):
                return older.parent
    return named


def _words(job: Job) -> str:
    named = {group: job.choices.get(group) for group in ("model", "ablation", "tuned", "data", "scale")}
    return "_".join(f"tuned_{word}" if group == "tuned" else word for group, word in named.items() if word)


def _same_run(folder: Path, job: Job) -> bool:
    """Whether a folder that an older version of apex_lab named holds this job's run."""
    try:
        record = read_json(folder / RECORD)
        format = record.get("format", 1)
        if format == FORMAT:  # begun by an older version, resumed by this one
            return record.get("fingerprint") == fingerprint(job.raw)
        if not isinstance(format, int) or not 1 <= format < FORMAT:
            return False
        stored = yaml.safe_load((folder / "config.yaml").read_text())
        return fingerprint(upgraded(stored, format)) == fingerprint(job.raw)
    except (UserError, OSError, yaml.YAMLError, KeyError, TypeError, AttributeError, UnicodeDecodeError):
        return False  # damaged, so it cannot be recognised


Outcome = Literal["finished", "failed", "interrupted", "diverged", "pruned"]
"""How a run's last attempt ended; null in the record while it is running."""


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
        return self.folder / RECORD

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
        """Records that work begins or resumes, and with what."""
        make_folder(self.folder / "checkpoints")
        for part in self.folder.rglob(".*.part"):
            part.unlink()  # left by a kill in the middle of writing
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
            "history": history,
            "command": command,
            "overrides": list(self.job.overrides),
            **{group: choices.get(group) for group in ("model", "ablation", "data", "scale", "experiment", "tuned")},
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

    def beat(self, **entries: Any) -> None:
        """Changes entries of the record, and shows that the process is alive."""
        self.update(**entries, heartbeat=_now())

    def finish(self) -> None:
        """Records that everything is done."""
        self.update(status="finished", outcome="finished", reason=None, finished=_now())

    def fail(self, reason: str, outcome: Outcome = "failed") -> None:
        """Records why work ended early; the same command resumes from the last checkpoint."""
        self.update(status="failed", outcome=outcome, reason=reason, finished=_now())

    def save(self) -> None:
        """Writes run.json."""
        write_json(self.record_file, self.record)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
