"""Commands as processes of their own that can be killed at any moment, without paying for their imports each time.

`multiprocessing`'s fork server imports the entry points once; every command is a fork of it that runs its module as
`python -m` does, in a session of its own, so that its whole group can be killed. All signals are real.
"""

from __future__ import annotations

import _pyio
import atexit
import builtins
import contextlib
import errno
import faulthandler
import importlib
import io
import json
import multiprocessing
import os
import random
import re
import resource
import runpy
import signal
import stat
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

SERVER = multiprocessing.get_context("forkserver")
PRELOADED = [
    *("tests.kills.processes", "tests.tiny", "apex_lab.train", "apex_lab.evaluate", "apex_lab.predict"),
    *("apex_lab.training.fit", "apex_lab.data.p2d", "apex_lab.view", "apex_lab.models.apex", "sims.p2d.__main__"),
]

PATIENCE_S = 600.0
"""Seconds after which a command is taken for stuck."""

POLL_S = 0.015

MARK = "KILLS_COMMAND"
"""Variable by which processes of a command are known."""

CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "shutil.rmtree")
"""What Python announces before it changes a folder, besides opening a file to write."""


@dataclass(frozen=True)
class Moment:
    """When and how a command ends before its time.

    Attributes:
        signum: the signal that it gets; None: its memory is limited.
        seconds: after so much processor time of it and its children, or
        change: before its so-manieth change to files, or
        growth: where its address space would grow by more bytes than these.
        alone: the process alone gets the signal, not its group.
    """

    signum: int | None
    seconds: float | None = None
    change: int | None = None
    growth: int | None = None
    alone: bool = False

    def __str__(self) -> str:
        if self.signum is None:
            return f"memory limited to {(self.growth or 0) / 2**20:.1f} MB more"
        when = f"after {self.seconds:.3f} s" if self.seconds is not None else f"before change {self.change} of files"
        return f"{signal.Signals(self.signum).name} {when}{', alone' if self.alone else ''}"


@dataclass(frozen=True)
class Measured:
    """What an unbroken command took: processor seconds, changes to files, bytes of address space."""

    seconds: float
    changes: int
    growth: int


@dataclass
class Ended:
    """How a command ended: exit code (negative: by a signal), all that it said, what it took."""

    code: int
    said: str
    measured: Measured


class Running:
    """A command at work.

    Args:
        entry: its module, as of `python -m`.
        words: its arguments.
        folder: where it runs.
        moment: when it is to be killed.
        variables: of its environment, beside those of this process.
        writes: how many writes to files in its folder succeed before its disk is full; None: it never is.
        logs: where what it says is kept; by default beside its folder.
    """

    count = 0

    def __init__(
        self,
        entry: str,
        words: Sequence[str],
        folder: Path,
        moment: Moment | None = None,
        variables: Mapping[str, str] | None = None,
        writes: int | None = None,
        logs: Path | None = None,
    ) -> None:
        Running.count += 1
        self.folder, self.moment = folder, moment
        self.log = (logs or folder.parent) / f".{folder.name}_{Running.count}.log"
        self.mark = f"{os.getpid()}_{Running.count}"
        order = {
            **{"entry": entry, "words": list(words), "folder": str(folder), "log": str(self.log)},
            **{"variables": {**(variables or {}), MARK: self.mark}, "moment": moment, "writes": writes},
        }
        os.environ.setdefault("JE_ARROW_MALLOC_CONF", "background_thread:false")  # of Arrow; a fork would lose it
        SERVER.set_forkserver_preload(PRELOADED)  # not in the commands, whose loaders have servers of their own
        self.process = SERVER.Process(target=_command, args=(order,), name=self.mark)
        self.process.start()
        self.pid = self.process.pid or 0

    def end(self, children: bool = True) -> Ended:
        """Waits for the end, sending the signal when it is due; nothing of the command is left running then.

        Args:
            children: whether it has any whose processor time counts too, which is costly to look at.
        """
        began, used, sent = time.monotonic(), 0.0, False
        due = self.moment.seconds if self.moment is not None else None
        while self.process.exitcode is None:
            self.process.join(POLL_S)
            if due is not None or self.moment is None:
                used = max(used, _seconds(self.pid, children))
            if due is not None and not sent and used >= due:
                sent = self.send()
            if time.monotonic() - began > PATIENCE_S:
                self._kill_all()
                raise AssertionError(f"it did not end; it said:\n{self.said()}")
        self._settle()
        about = self.log.with_suffix(".json")
        found = {"changes": 0, "growth": 0}
        with contextlib.suppress(OSError, ValueError):  # it was killed before or while it wrote that
            found = json.loads(about.read_text())
        return Ended(self.process.exitcode, self.said(), Measured(used, found["changes"], found["growth"]))

    def seconds(self) -> float:
        """Processor time that it has taken so far."""
        return _seconds(self.pid)

    def send(self) -> bool:
        """Sends the moment's signal."""
        assert self.moment is not None
        assert self.moment.signum is not None
        try:
            (os.kill if self.moment.alone else os.killpg)(self.pid, self.moment.signum)
        except ProcessLookupError:  # not in its group yet, or over
            return False
        return True

    def said(self) -> str:
        """All that it has printed so far."""
        return self.log.read_text(errors="replace") if self.log.exists() else ""

    def _others(self) -> list[psutil.Process]:
        """Processes of the command that still live: those of its session, and what they have started elsewhere."""
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error, OSError):
                ours = os.getsid(process.pid) == self.pid or process.environ().get(MARK) == self.mark
                if ours and process.status() != psutil.STATUS_ZOMBIE:
                    found.append(process)
        return found

    def _settle(self) -> None:
        """Waits until workers have noticed that the command is gone."""
        end = time.monotonic() + 120
        while left := self._others():
            if time.monotonic() > end:
                self._kill_all()
                raise AssertionError(f"these outlived the command: {[each.cmdline() for each in left]}")
            time.sleep(0.1)

    def _kill_all(self) -> None:
        for process in self._others():
            process.kill()


def _seconds(pid: int, children: bool = True) -> float:
    """Processor time of a process, and its children, so far."""
    try:
        root = psutil.Process(pid)
        return sum(sum(each.cpu_times()[:4]) for each in (root, *(root.children() if children else ())))
    except (psutil.Error, OSError):
        return 0.0


def _command(order: dict[str, Any]) -> None:
    """In the fork: becomes the command."""
    os.setsid()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # as the packages do under `python -m`; the server has them already
    os.chdir(order["folder"])
    os.environ.update(order["variables"], PWD=order["folder"])
    log = os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    nowhere = os.open(os.devnull, os.O_RDONLY)
    for number, file in enumerate((nowhere, log, log)):
        os.dup2(file, number)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115 - multiprocessing has closed it
    if order["moment"] is not None and order["moment"].signum is None:
        _import(order["entry"])  # what is there is measured, so a limit of memory is one of the work
    counted, runs = _count_changes(order["moment"]), [True]
    if order["writes"] is not None:
        _fill_up(Path(order["folder"]), order["writes"], runs)
    before = _address_space()
    faulthandler.dump_traceback_later(PATIENCE_S - 60, file=sys.__stderr__ or 2)  # where it is stuck
    _limit(order["moment"], before)
    warnings.filterwarnings("ignore", message=".*found in sys.modules after import.*")  # the server's
    sys.argv = [order["entry"], *order["words"]]
    code: Any = 0
    try:
        runpy.run_module(order["entry"], run_name="__main__", alter_sys=True)
    except SystemExit as stop:
        code = stop.code
    except BaseException:
        traceback.print_exc()
        raise
    finally:
        atexit._run_exitfuncs()  # which multiprocessing does not
        runs[0] = False
        counted[1] = 0
        faulthandler.cancel_dump_traceback_later()
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        about = {"changes": counted[0], "growth": _address_space("VmPeak") - before}
        Path(order["log"]).with_suffix(".json").write_text(json.dumps(about))
    sys.exit(code)


def _import(entry: str) -> None:
    """Imports what a command imports, which the server may not have."""
    module = importlib.import_module(entry)
    if hasattr(module, "__path__"):
        importlib.import_module(f"{entry}.__main__")


def _count_changes(moment: Moment | None) -> list[int]:
    """Counts changes to files from now on, and ends the process before the one that is due."""
    counted, me = [0, 1], os.getpid()  # so many; whether the command is at work

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            if not isinstance(arguments[0], str | bytes) or not arguments[2] & (os.O_WRONLY | os.O_RDWR):
                return
        elif event not in CHANGES:
            return
        if os.getpid() != me or not counted[1]:
            return
        counted[0] += 1
        if moment is not None and moment.signum is not None and counted[0] == moment.change:
            (os.kill if moment.alone else os.killpg)(me, moment.signum)

    sys.addaudithook(hook)
    return counted


def _fill_up(folder: Path, writes: int, runs: list[bool]) -> None:
    """Lets the disk of a folder be full after so many writes, while the command runs.

    Python's own files are then written in Python, through `os.write`.
    """
    left, real, place = [writes], {name: getattr(os, name) for name in ("write", "pwrite")}, folder.stat().st_dev

    def full(name: str) -> Callable[..., int]:
        def write(file: int, *rest: Any) -> int:
            about = os.fstat(file)
            if file > 2 and stat.S_ISREG(about.st_mode) and about.st_dev == place:
                left[0] -= 1
                if left[0] < 0 and runs[0]:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return int(real[name](file, *rest))

        return write

    for name in real:
        setattr(os, name, full(name))
    builtins.open = io.open = _pyio.open  # type: ignore[assignment]


def _limit(moment: Moment | None, before: int) -> None:
    if moment is not None and moment.growth is not None:
        most = before + moment.growth
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))


def _address_space(name: str = "VmSize") -> int:
    """Bytes; 0 where the system does not tell."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:"))


START_BYTES = 2**25
"""What Python itself needs to start a module that is imported already."""

IGNORED = re.compile(r"Exception ignored in.*\nTraceback \(most recent call last\):")
"""What Python prints of libraries whose own clearing up lacks memory."""


def drawn(draw: random.Random, whole: Measured, signals: Sequence[int | None], alone: bool = False) -> Moment:
    """A random moment of a command that would take so much.

    Args:
        draw: where chance comes from.
        whole: what the unbroken command takes.
        signals: to choose from; None: a limit of memory.
        alone: whether the process may get the signal alone.
    """
    signum = draw.choice(list(signals))
    by_itself = alone and draw.random() < 0.5
    if signum is None:
        # most of the growth is room that is reserved and never used, so small limits are the ones that matter
        return Moment(None, growth=START_BYTES + int(whole.growth * draw.random() ** 4))
    if whole.changes > 1 and draw.random() < 0.4:
        return Moment(signum, change=draw.randrange(1, whole.changes + 1), alone=by_itself)
    return Moment(signum, seconds=draw.uniform(0.0, 0.9 * whole.seconds), alone=by_itself)


@dataclass
class Tally:
    """What a series of kills did.

    Attributes:
        seed: of its chance.
        kills: signal or "memory" -> how many commands it ended.
        moments: all of them, in words.
        unhurt: moments that came after the end of the command, or limits that sufficed.
    """

    seed: str
    kills: dict[str, int] = field(default_factory=dict)
    moments: list[str] = field(default_factory=list)
    unhurt: int = 0

    def add(self, moment: Moment, ended: Ended) -> bool:
        """Notes how a command took its moment; whether that ended it."""
        self.moments.append(f"{moment} -> {ended.code}")
        if ended.code == 0:
            self.unhurt += 1
            return False
        name = "memory" if moment.signum is None else signal.Signals(moment.signum).name
        self.kills[name] = self.kills.get(name, 0) + 1
        return True

    @property
    def count(self) -> int:
        """Commands that were ended before their time."""
        return sum(self.kills.values())

    def __str__(self) -> str:
        kinds = ", ".join(f"{count} {name}" for name, count in sorted(self.kills.items()))
        return f"seed {self.seed}: {self.count} kills ({kinds}), {self.unhurt} moments came too late"


def untold(moment: Moment, ended: Ended) -> str | None:
    """What is wrong with the end of a command that could still speak; None: nothing.

    A request to stop ends in one sentence and 128 + n; want of memory in a sentence and a code, or in the system's own
    end of the process; a traceback is never what a user sees.
    """
    said = IGNORED.sub("", ended.said) if moment.signum is None else ended.said
    if "Traceback (most recent call last)" in said:
        return "a traceback"
    if moment.signum in (signal.SIGTERM, signal.SIGINT) and ended.code not in (128 + moment.signum, -moment.signum):
        return f"exit code {ended.code} after {signal.Signals(moment.signum).name}"
    return None


Results = Callable[[Path], dict[str, Any]]
"""Everything that a finished command leaves in its folder and that must not depend on kills: name -> content."""
