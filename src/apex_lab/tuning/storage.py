"""Where a study is kept for all its workers: a journal file, SQLite or another database; with heartbeats.

Optuna fails a trial whose heartbeat has stopped, and calls us to run it again. It has heartbeats for databases; for
journal files they are here: a file per trial beside the journal, touched by its worker.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import optuna
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages._heartbeat import BaseHeartbeat  # what Optuna's own storages inherit; it has no public name
from optuna.storages.journal import JournalFileBackend
from optuna.storages.journal._file import get_lock_file  # its release after a time; it has no public name
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, unwritable
from apex_lab.base.validation import one_line, sentence

Stale = Callable[[optuna.Study, FrozenTrial], None]

GRACE = 4
"""A trial is lost after so many heartbeats without one."""


class _File(JournalFileBackend):
    """A journal file that kills and full disks leave readable.

    Optuna's lock is a link to the journal. Of a relative path it leads nowhere, and then the lock of a killed worker is
    waited for without end, instead of the 30 seconds after which it is taken away; so the path is absolute here.

    Args:
        path: the journal.
    """

    def __init__(self, path: Path) -> None:
        self._path = path.absolute()
        lock = self._path.with_name(f"{self._path.name}.lock")
        if lock.is_symlink() and not lock.exists():  # of an earlier version, which gave the path as it came
            lock.unlink(missing_ok=True)
        super().__init__(str(self._path))

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """Appends lines, after what half a line a death or a full disk has left is cut off."""
        with get_lock_file(self._lock):
            _cut_off_half_a_line(self._path)
        try:
            super().append_logs(logs)
        except OSError as error:
            raise unwritable(self._path, error) from error


def _cut_off_half_a_line(path: Path) -> None:
    with open(path, "r+b") as file:
        size = file.seek(0, os.SEEK_END)
        place = size
        while place:  # the last line may be long
            start = max(0, place - 4096)
            file.seek(start)
            end = file.read(place - start).rfind(b"\n")
            if end >= 0:
                place = start + end + 1
                break
            place = start
        if place < size:
            file.truncate(place)


class Journal(JournalStorage, BaseHeartbeat):
    """A journal file with heartbeats.

    Times are those that the file system stamps, so clocks of machines that share a folder need not agree.

    Args:
        path: the journal.
        interval_s: seconds between heartbeats.
        stale: called with a trial that was lost, after it was failed.
    """

    def __init__(self, path: Path, interval_s: int, stale: Stale) -> None:
        super().__init__(_File(path))
        self._alive = make_folder(path.with_name(f"{path.name}.alive"))
        self._interval, self._stale = interval_s, stale

    def record_heartbeat(self, trial_id: int) -> None:
        (self._alive / str(trial_id)).touch()

    def _get_stale_trial_ids(self, study_id: int) -> list[int]:
        clock = self._alive / "now"
        clock.touch()
        now, found = clock.stat().st_mtime, []
        for trial in self.get_all_trials(study_id, deepcopy=False):
            file = self._alive / str(trial._trial_id)
            if trial.state.is_finished():
                file.unlink(missing_ok=True)
            if trial.state != TrialState.RUNNING or not file.exists():  # none yet: it has just begun
                continue
            last = file.stat().st_mtime
            if now - last > GRACE * self._interval:
                found.append(trial._trial_id)
        return found

    def get_heartbeat_interval(self) -> int:
        return self._interval

    def get_heartbeat_stale_trial_callback(self) -> Stale:
        return self._stale


def open_storage(url: str | None, folder: Path, interval_s: int, stale: Stale) -> BaseStorage:
    """Opens a storage, and makes it where it is missing.

    Args:
        url: a path of a journal file, or a URL as SQLAlchemy reads it; None: journal.log in the study's folder.
        folder: of the study.
        interval_s: seconds between heartbeats.
        stale: called with a trial that was lost, after it was failed.

    Raises:
        UserError: it cannot be opened.
    """
    if url is None or "://" not in url:
        path = Path(url) if url is not None else folder / "journal.log"
        make_folder(path.parent)
        try:
            return Journal(path, interval_s, stale)
        except OSError as error:
            raise unwritable(path, error) from error
        except (ValueError, KeyError, AssertionError) as error:
            raise UserError(
                f"study.storage: {path} is not a journal of Optuna ({one_line(error)}): move it."
            ) from error
    return _database(url, interval_s, stale)


def _database(text: str, interval_s: int, stale: Stale) -> BaseStorage:
    try:
        url = make_url(text)
        if url.drivername == "postgresql":  # psycopg 3, whatever this version of SQLAlchemy takes by itself
            url = url.set(drivername="postgresql+psycopg")
        if url.get_backend_name() == "sqlite" and url.database:
            make_folder(Path(url.database).parent)
        connect = {"timeout": 60} if url.get_backend_name() == "sqlite" else {}  # seconds that a lock is waited for
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            return RDBStorage(
                url.render_as_string(hide_password=False),
                engine_kwargs={"connect_args": connect, "pool_pre_ping": True},
                heartbeat_interval=interval_s,
                grace_period=GRACE * interval_s,
                heartbeat_stale_trial_callback=stale,
            )
    except ImportError as error:
        raise UserError(
            f"study.storage = {shown_url(text)} needs a driver that is not installed ({one_line(error)}): "
            "PostgreSQL's comes with pip install 'apex_lab[tune]'."
        ) from error
    except (SQLAlchemyError, RuntimeError, optuna.exceptions.StorageInternalError) as error:
        raise UserError(
            sentence(f"study.storage = {shown_url(text)} cannot be opened: {one_line(str(error).splitlines()[0])}")
        ) from error


def shown_url(text: str) -> str:
    """A URL without its password."""
    try:
        return make_url(text).render_as_string(hide_password=True) if "://" in text else text
    except ArgumentError:
        return text
