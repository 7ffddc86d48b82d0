"""A pool of worker processes that make items; a dead worker is replaced and its item retried."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe, wait

from recordings.errors import RecordingError
from recordings.files import no_room
from recordings.layout import Key
from recordings.manifest import Record
from recordings.plan import Facts
from recordings.worker import Job, Message, Workshop

TRIES = 3
"""Attempts at an item (or at the start of a worker) before the death of its worker becomes an error."""


@dataclass(frozen=True)
class Task:
    """An item to make; with `expected`, it is written only if it has that checksum."""

    key: Key
    expected: str | None = None


class Pool:
    """Worker processes for one folder. A context manager: all workers have ended when it exits.

    Args:
        job: what the workers get.
        workers: how many.
        recycle: items after which a worker is replaced; None: never.
    """

    def __init__(self, job: Job, workers: int, recycle: int | None = None) -> None:
        self.job, self.size, self.recycle = job, workers, recycle
        self.workers: dict[Connection, _Worker] = {}
        self.deaths: Counter[Key | None] = Counter()
        self.facts: Facts | None = None

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self.workers.values():
            worker.stop()
        for worker in self.workers.values():
            worker.end()
        self.workers = {}

    def start(self) -> Facts:
        """Starts the first worker; returns the facts of the maker.

        Raises:
            RecordingError: the maker cannot work here.
        """
        while self.facts is None:
            if not self.workers:
                self._add()
            for worker, message in self._messages():
                self._handle(worker, message, deque())
        return self.facts

    def run(self, tasks: Iterable[Task]) -> Iterator[tuple[Key, Record]]:
        """Makes all items; yields each when its bytes have been written, in the order in which they finish.

        Raises:
            RecordingError: an item cannot be made or has another checksum than expected, or the disk is full.
        """
        queue = deque(tasks)
        left = len(queue)
        while left:
            while len(self.workers) < min(self.size, left):
                self._add()
            for worker in self.workers.values():
                if worker.idle and queue:
                    worker.give(queue.popleft())
            for worker, message in self._messages():
                done = self._handle(worker, message, queue)
                if done is not None:
                    left -= 1
                    yield done

    def _add(self) -> None:
        worker = _Worker(self.job)
        self.workers[worker.connection] = worker

    def _messages(self) -> Iterator[tuple[_Worker, Message | None]]:
        """Waits for messages; yields each with its worker, or None as the message of a dead worker."""
        for connection in wait(list(self.workers)):
            worker = self.workers[connection]  # type: ignore[index]
            try:
                yield worker, worker.connection.recv()
            except (EOFError, OSError):
                yield worker, None

    def _handle(self, worker: _Worker, message: Message | None, queue: deque[Task]) -> tuple[Key, Record] | None:
        if message is None:
            self._replace(worker, queue)
            return None
        if message[0] == "ready":
            self.facts = message[1]
            worker.ready = True
            self.deaths[None] = 0
            return None
        done = finished(message, self.job, worker.task)
        worker.take()
        if self.recycle is not None and worker.made >= self.recycle:
            del self.workers[worker.connection]
            worker.stop()
            worker.end()
        return done

    def _replace(self, worker: _Worker, queue: deque[Task]) -> None:
        """Removes a dead worker and puts its item at the front of the queue, or raises after `TRIES` deaths."""
        del self.workers[worker.connection]
        code = worker.end()
        key = worker.task.key if worker.task else None
        self.deaths[key] += 1
        if self.deaths[key] >= TRIES:
            what = f"making {_name(self.job, key)}" if key else "starting"
            raise RecordingError(f"a worker died {TRIES} times while {what} ({_cause(code)}): {worker.last_line()}")
        if worker.task:
            queue.appendleft(worker.task)


class Alone:
    """Makes items in this process: for few small ones, where starting workers would take longer. As `Pool`."""

    def __init__(self, job: Job) -> None:
        self.job, self.workshop = job, Workshop(job)

    def __enter__(self) -> Alone:
        return self

    def __exit__(self, *_: object) -> None:
        self.workshop.close()

    def start(self) -> Facts:
        """The facts of the maker."""
        kind, content = self.workshop.ready()
        if kind == "failed":
            raise RecordingError(content)
        facts: Facts = content
        return facts

    def run(self, tasks: Iterable[Task]) -> Iterator[tuple[Key, Record]]:
        """Makes all items in their order."""
        for task in tasks:
            message = self.workshop.make(*task.key, task.expected)
            assert message is not None
            yield finished(message, self.job, task)


def finished(message: Message, job: Job, task: Task | None) -> tuple[Key, Record]:
    """The finished item that a message tells of.

    Raises:
        RecordingError: it tells of a failure.
    """
    kind, *content = message
    if kind == "failed":
        raise RecordingError(content[0])
    if kind == "disk":
        raise no_room(OSError(content[0], ""), content[1])
    assert task is not None
    if kind == "differs":
        raise RecordingError(
            f"{_name(job, task.key)} came out with other bytes than those recorded in {job.root}: it was made with "
            "other versions or on another kind of processor; repair it there, or generate the data again"
        )
    return task.key, Record(checksum=content[0], notes=content[1])


class _Worker:
    def __init__(self, job: Job) -> None:
        self.connection, theirs = Pipe()
        self.log = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the process
        self.task: Task | None = None
        self.ready = False
        self.made = 0
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path),
            "PYTHONHASHSEED": "0",  # the same order of sets in every worker
            "OMP_NUM_THREADS": "1",  # one core per worker, and sums in one order
            "OPENBLAS_NUM_THREADS": "1",
            "MKL_NUM_THREADS": "1",
        }
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "recordings.worker", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=self.log,
                stderr=self.log,
                env=environment,
            )
        self._send(job)

    @property
    def idle(self) -> bool:
        return self.ready and self.task is None

    def give(self, task: Task) -> None:
        self.task = task
        self._send((*task.key, task.expected))

    def take(self) -> None:
        self.task = None
        self.made += 1

    def _send(self, message: object) -> None:
        try:
            self.connection.send(message)
        except OSError:
            return  # the worker is dead: the next read from it returns None

    def stop(self) -> None:
        """Asks the process to end."""
        self.connection.close()
        if self.task is not None or not self.ready:
            self.process.terminate()

    def end(self) -> int:
        """Waits for the process to end, killing it after 5 seconds; returns its exit code."""
        try:
            code = self.process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self.process.kill()
            code = self.process.wait()
        self.connection.close()
        return code

    def last_line(self) -> str:
        """The last line that the process printed."""
        self.log.seek(0)
        lines = self.log.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it printed nothing"


def _name(job: Job, key: Key) -> str:
    return f"{job.item} {key[0]}/{key[1]}"


def _cause(code: int) -> str:
    if code == -9:
        return "killed, perhaps for lack of memory: try fewer workers"
    return f"ended by signal {-code}" if code < 0 else f"exit code {code}"
