"""What a run is doing, read from its folder by other processes: `status`, sweeps, tables. Imports no PyTorch.

A run is alive while its process touches the lock file of its folder every `BEAT` seconds; one that was not touched for
`LOST` seconds, or whose process is gone from this machine, is lost: the same command resumes it.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec

from apex_lab.base.errors import UserError
from apex_lab.base.files import read_json
from apex_lab.base.processes import alive
from apex_lab.runs.record import read_record

RECORD = "run.json"
RESULTS = "metrics.json"
LOCK = ".lock"

BEAT = 20.0
LOST = 120.0

State = Literal["waiting", "running", "lost", "paused", "interrupted", "failed", "finished", "damaged"]


@dataclass(frozen=True)
class RunState:
    """A run as it stands.

    Attributes:
        folder: of the run; need not exist.
        state: waiting (never started), running, lost (its process died without a word), paused (by
            trainer.max_minutes), interrupted (by a signal), failed (by itself; diverged included), finished, damaged
            (its record cannot be read).
        reason: why it ended early, in a sentence.
        record: content of run.json; empty where there is none.
    """

    folder: Path
    state: State
    reason: str | None
    record: dict[str, Any]

    @property
    def steps(self) -> int:
        """Weight updates done."""
        value = self.record.get("steps", 0)
        return value if isinstance(value, int) else 0

    @property
    def seconds(self) -> float:
        """Of training, over all restarts."""
        value = self.record.get("seconds", 0.0)
        return float(value) if isinstance(value, int | float) else 0.0

    @property
    def owner(self) -> str:
        """The process that works in it or did last."""
        return f"process {self.record.get('pid')} on {self.record.get('host')}"


def read_state(folder: Path, split: str | None = None) -> RunState:
    """The state of a run folder; damage becomes a state, never an exception.

    Args:
        folder: of the run; need not exist.
        split: whose scores a finished run must have, as `has_scores` reads them. None: metrics.json only needs an end,
            for a look at thousands of runs whose results may lie on another machine.
    """
    file = folder / RECORD
    if not file.is_file():
        return RunState(folder, "waiting", None, {})
    try:
        record = read_record(file)
    except UserError as error:
        return RunState(folder, "damaged", str(error), {})
    state, reason = _state(folder, record, split)
    return RunState(folder, state, reason, record)


class _Split(msgspec.Struct):
    """What every split of a whole metrics.json has; rows per video, nearly all of the file, are not even built."""

    total: dict[str, float | int | None]
    terms: dict[str, float | int | None] | msgspec.UnsetType = msgspec.UNSET


class _Results(msgspec.Struct):
    splits: dict[str, _Split]


_DECODER = msgspec.json.Decoder(_Results)


def has_scores(folder: Path, split: str) -> bool:
    """Whether a run folder holds a whole metrics.json with the scores of a split."""
    file = folder / RESULTS
    try:
        return split in _DECODER.decode(file.read_bytes()).splits
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        pass
    try:  # of an earlier version, with NaN
        splits = msgspec.convert(read_json(file), _Results).splits
    except (UserError, msgspec.MsgspecError, RecursionError):
        return False
    return split in splits


def is_whole(scored: object) -> bool:
    """Whether an entry of metrics.json's `splits` has scores, which are numbers or null."""
    try:
        msgspec.convert(scored, _Split)
    except (msgspec.MsgspecError, RecursionError):
        return False
    return True


def _has_end(file: Path) -> bool:
    """Whether a JSON file of a dictionary is there and was not cut off."""
    try:
        with open(file, "rb") as opened:
            opened.seek(max(0, file.stat().st_size - 8))
            return opened.read().rstrip().endswith(b"}")
    except OSError:
        return False


def _state(folder: Path, record: dict[str, Any], split: str | None) -> tuple[State, str | None]:
    status, outcome, reason = record.get("status"), record.get("outcome"), record.get("reason")
    reason = reason if isinstance(reason, str) else None
    if status == "running":
        return ("running", None) if _alive(folder, record) else ("lost", "its process died without a word")
    if status == "finished":
        if has_scores(folder, split) if split is not None else _has_end(folder / RESULTS):
            return "finished", None
        return "interrupted", f"its {RESULTS} is {'damaged' if (folder / RESULTS).is_file() else 'gone'}"
    if status == "paused" or outcome == "paused":
        return "paused", reason
    if outcome == "interrupted":
        return "interrupted", reason
    if status == "failed":
        return "failed", reason
    return "damaged", f"{folder / RECORD} has the status {status!r}."


def _alive(folder: Path, record: dict[str, Any]) -> bool:
    """Whether the process that works in a folder is there."""
    pid = record.get("pid")
    if record.get("host") == socket.gethostname() and isinstance(pid, int) and not alive(pid):
        return False
    try:
        return time.time() - (folder / LOCK).stat().st_mtime < LOST
    except OSError:
        return False


@contextmanager
def beating(folder: Path) -> Iterator[None]:
    """Inside, a thread shows that this process works in a run folder."""
    stop = threading.Event()
    _touch(folder)

    def beat() -> None:
        while not stop.wait(BEAT):
            _touch(folder)

    thread = threading.Thread(target=beat, daemon=True, name="heartbeat")
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def _touch(folder: Path) -> None:
    with suppress(OSError):  # a full or vanished disk is reported by whoever writes next
        os.utime(folder / LOCK)
