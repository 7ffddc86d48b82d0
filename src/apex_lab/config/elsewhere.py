"""A job of a sweep in another process than the sweep: what the worker of a launcher does. Imports no PyTorch.

A launcher's worker (joblib's, submitit's, Ray's) starts each job as a command of its own, `python -m apex_lab.train`
with the job's words, and waits for it. So

- a job that is killed, by a lack of memory say, takes neither the worker nor the other jobs along;
- a job has its share of cores and GPUs before PyTorch and CUDA start;
- a job's lines are told from those of others;
- a request to stop reaches a job once, wherever it came from, and the job stores its step.

Requests come from three sides: as a signal to the worker (Slurm's warnings), through the file `Origin.stop` (a signal
to the sweep's own process), and from the death of the sweep's own process on this machine.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from hydra.core.hydra_config import HydraConfig

from apex_lab.base import attached, console, interrupts, slots
from apex_lab.base.interrupts import Interrupted
from apex_lab.base.processes import alive
from apex_lab.config.sweeps import JobBusy, JobFailed, JobStopped

POLL = 0.2
"""Seconds between two looks at a job and at requests to stop."""

_NOT_FOR_JOBS = ("hydra/launcher", "hydra.launcher", "hydra/sweeper", "hydra.sweeper", "hydra.sweep.", "hydra.mode")
"""Beginnings of Hydra's words that mean the sweep and not its jobs."""


@dataclass(frozen=True)
class Origin:
    """The process that a sweep was started in, and what its jobs need of it.

    Attributes:
        host, pid: of the process.
        folder: its working directory, in which jobs run.
        module: what jobs are started with, such as apex_lab.train.
        options: of its command line that jobs need too.
        common: words that all jobs share, so that the others tell a job.
        stop: name of a file in the sweep's folder that holds the number of a signal once the sweep was asked to stop.
        path: where its modules are found.
    """

    host: str
    pid: int
    folder: str
    module: str
    options: tuple[str, ...]
    common: frozenset[str]
    stop: str
    path: tuple[str, ...]

    @classmethod
    def here(cls, module: str, options: Sequence[str], jobs: Sequence[Sequence[str]]) -> Origin:
        """This process."""
        common = frozenset.intersection(*map(frozenset, jobs)) if jobs else frozenset()
        inside = (sys.prefix, sys.base_prefix)
        path = tuple(os.path.abspath(entry) for entry in sys.path if not entry.startswith(inside))
        host, pid = socket.gethostname(), os.getpid()
        stop = f".stop_{host}_{pid}_{time.time_ns()}"
        return cls(host, pid, os.getcwd(), module, tuple(options), common, stop, path)

    def stop_file(self, sweep_folder: str) -> Path:
        """The file of `stop`."""
        return Path(self.folder, sweep_folder, self.stop)

    def asked_to_stop(self, sweep_folder: str) -> int | None:
        """The signal that the sweep got; SIGTERM where its process died, and its jobs with it."""
        with contextlib.suppress(OSError, ValueError):
            return int(self.stop_file(sweep_folder).read_text())
        here = self.host == socket.gethostname() and os.environ.get("SUBMITIT_EXECUTOR") != "slurm"
        # jobs in a queue of Slurm's outlive the process that has put them there
        return signal.SIGTERM if here and not alive(self.pid) else None

    def relaying(self, launcher: Any, sweep_folder: str) -> contextlib.AbstractContextManager[None]:
        """`relaying` for the jobs of a launcher of Hydra's."""
        if hasattr(launcher, "ray_cfg"):
            start_ray(launcher.ray_cfg.init)
            return relaying(self.stop_file(sweep_folder), ())  # Ray keeps Ctrl-C from its workers itself
        if hasattr(launcher, "params"):  # submitit's
            console.say(f"What jobs say stands in {sweep_folder}/.submitit.")
        return relaying(self.stop_file(sweep_folder), (signal.SIGINT, signal.SIGTERM))


def run(origin: Origin) -> str:
    """Does the job that Hydra has composed, as a command of its own.

    Returns:
        How it ended, where it came to its end: finished or paused.

    Raises:
        JobFailed, JobBusy, JobStopped: else; they come back through Hydra's job return.
    """
    console.setup()
    words = HydraConfig.get().overrides
    title = " ".join(word for word in words.task if word not in origin.common) or origin.module
    own = [*words.task, *(word for word in words.hydra if not word.lstrip("+~").startswith(_NOT_FOR_JOBS))]
    folder, told = str(HydraConfig.get().sweep.dir), False
    with _noting() as noted:

        def asked() -> int | None:
            return noted.signum or origin.asked_to_stop(folder)

        def idle() -> None:
            nonlocal told
            if not told:
                console.say(f"[{title}] waits for a free slot on {socket.gethostname()}")
                told = True
            _stop_if(asked())

        try:
            with _slot(idle) as slot:
                _stop_if(asked())
                return _supervise(origin, own, title, slot, asked)
        except JobStopped:
            noted.pass_on()
            _end_orphan(origin)
            raise


def _end_orphan(origin: Origin) -> None:
    """Ends a worker of joblib whose sweep was killed, else it waits for jobs and holds the sweep's output open."""
    if multiprocessing.current_process().name.startswith("Loky") and not alive(origin.pid):
        os._exit(128 + signal.SIGTERM)


def _stop_if(signum: int | None) -> None:
    if signum is not None:
        raise JobStopped(signum)


def _slot(idle: Callable[[], None]) -> contextlib.AbstractContextManager[slots.Slot | None]:
    """One of this machine's slots; none where the sweep does not divide it."""
    hydra = HydraConfig.get()
    number = hydra.sweeper.get("slots")
    if number is None:
        number = hydra.launcher.get("n_jobs")  # joblib's
    if number is None:
        return contextlib.nullcontext()
    if number < 1:  # joblib's way to count from the number of cores downwards
        number = max(1, (os.cpu_count() or 1) + 1 + number)
    return slots.claimed(slots.machine(number), slots.folder(), idle)


def _supervise(
    origin: Origin, words: Sequence[str], title: str, slot: slots.Slot | None, asked: Callable[[], int | None]
) -> str:
    """Runs a job in a slot until it ends; passes a request to stop on, once."""
    with tempfile.TemporaryDirectory(prefix="apex_lab_job_") as aside:
        end = Path(aside) / "end.json"
        process = subprocess.Popen(
            [sys.executable, "-m", origin.module, *words, *origin.options],
            cwd=origin.folder,
            env={
                **os.environ,
                **(slot.environment if slot else {}),
                attached.END: str(end),
                "PYTHONPATH": os.pathsep.join(origin.path),
            },
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C at a terminal reaches it through this process alone
        )
        if slot is not None:
            slot.pin(process.pid)
        assert process.stdin is not None
        with process.stdin:  # closed when this process ends in any way, which the job notices
            pumps = [_pump(process.stdout, 1, title), _pump(process.stderr, 2, title)]
            passed = None
            while True:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(POLL)
                    break
                if passed is None and (passed := asked()) is not None:
                    with contextlib.suppress(BrokenPipeError):  # it has just ended
                        process.stdin.write(str(int(passed)).encode())
                        process.stdin.flush()
            for pump in pumps:
                pump.join(timeout=5.0)  # a process that the job has left behind may hold the pipe
        return _outcome(end, process.returncode, passed)


def _pump(pipe: IO[bytes] | None, to: int, title: str) -> threading.Thread:
    """Passes on a job's lines, each with the job's title."""
    assert pipe is not None

    def pump() -> None:
        with pipe:
            for line in pipe:  # read to the end whoever listens, or the job would wait for that
                console.put(f"[{title}] {line.decode(errors='replace').rstrip()}\n", error=to == 2)

    thread = threading.Thread(target=pump, daemon=True)
    thread.start()
    return thread


def _outcome(end: Path, code: int, passed: int | None) -> str:
    """How a job ended, from what it has told and its exit code."""
    try:
        told: dict[str, Any] = json.loads(end.read_text(encoding="utf-8"))
    except (OSError, ValueError):  # it had no time to tell
        if passed is not None:
            raise JobStopped(passed) from None
        if code >= 0:
            raise JobFailed(f"its process ended with exit code {code} and no word: see its messages") from None
        memory = "; the machine may have run out of memory" if code == -signal.SIGKILL else ""
        raise JobFailed(f"its process was ended by {signal.Signals(-code).name}{memory}") from None
    reason = str(told["reason"])
    if told["state"] == "interrupted":
        raise JobStopped(passed or signal.Signals[reason])
    if told["state"] == "busy":
        raise JobBusy(reason)
    if told["state"] == "failed":
        raise JobFailed(reason)
    return str(told["state"])


REQUESTS = (*interrupts.ALWAYS, *interrupts.IF_FREE)
"""Signals that ask a worker to stop."""


@dataclass
class _Noted:
    """The first request to stop that came as a signal to this worker.

    Attributes:
        signum: the signal, or None.
        before: the launcher's own handlers.
    """

    signum: int | None
    before: dict[int, Any]

    def pass_on(self) -> None:
        """Lets submitit act on a signal, now that the job is stored: it asks Slurm for another start, and exits."""
        executor = os.environ.get("SUBMITIT_EXECUTOR")
        if executor is None or self.signum in (None, signal.SIGINT):
            return
        if self.signum == signal.SIGTERM and executor == "slurm":
            sys.exit(128 + signal.SIGTERM)  # without a result: Slurm itself starts a preempted job again, or cancels it
        handler = self.before[self.signum]
        if callable(handler):
            with contextlib.suppress(Exception):  # not started again: it says why
                handler(self.signum, None)


@contextlib.contextmanager
def _noting() -> Iterator[_Noted]:
    """Inside, requests to stop are only noted, also those that the sweep's process has blocked for its workers."""
    noted = _Noted(None, {})
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return

    def receive(signum: int, frame: object) -> None:
        noted.signum = noted.signum or signum

    noted.before = {number: signal.signal(number, receive) for number in REQUESTS}
    mask = signal.pthread_sigmask(signal.SIG_UNBLOCK, REQUESTS) if hasattr(signal, "pthread_sigmask") else None
    try:
        yield noted
    finally:
        if mask is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in noted.before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def start_ray(settings: Any) -> None:
    """Starts Ray, or connects to it, before this process listens for requests to stop: Ray sets handlers of its own."""
    os.environ.setdefault("RAY_DEDUP_LOGS", "0")  # else it leaves out lines that look alike
    import ray
    from omegaconf import OmegaConf

    if not ray.is_initialized():
        if settings.get("address") is None:
            settings.setdefault("object_store_memory", 78643200)  # as the launcher does: jobs keep nothing in there
        plain = OmegaConf.to_container(settings, resolve=True)
        assert isinstance(plain, dict)
        ray.init(**{str(key): value for key, value in plain.items()})


@contextlib.contextmanager
def relaying(stop: Path, alone: Sequence[int]) -> Iterator[None]:
    """For the sweep's process: the first request to stop goes to the jobs, and a second one stops at once.

    A terminal sends Ctrl-C to workers too, which would break off what they do; so they start deaf to it.

    Args:
        stop: the file of `Origin.stop`.
        alone: signals that workers which start in this block do not get.

    Raises:
        Interrupted: at the end of the block, when all jobs have stopped; with the second request, at once.
    """
    asked: int | None = None

    def receive(signum: int, frame: object) -> None:
        nonlocal asked
        if asked is not None:
            raise Interrupted(asked)
        asked = signum
        stop.write_text(str(int(signum)))
        with contextlib.suppress(OSError):  # print is not safe in here
            os.write(2, b"Stopping when all jobs have stored their steps; once more stops at once.\n")

    stop.parent.mkdir(parents=True, exist_ok=True)
    over = threading.Event()
    ear = threading.Thread(target=over.wait, daemon=True)  # gets the signals that this thread blocks
    ear.start()
    before = {number: signal.signal(number, receive) for number in REQUESTS}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, alone) if hasattr(signal, "pthread_sigmask") else None
    try:
        yield
        stop.unlink(missing_ok=True)  # else it stays for jobs that a queue starts later
    finally:
        if mask is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        over.set()
        ear.join()
    if asked is not None:
        raise Interrupted(asked)
