"""Runs scenarios on all cores: workers are replaced when they have done enough, die, or do not answer."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import time
from collections import Counter, deque
from collections.abc import Generator, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

from apex_lab.arrangement.task import Answer, Failure, Serve, Setting, Task
from apex_lab.arrangement.worker import serve
from apex_lab.base import interrupts

TRIES = 3
"""Attempts at a scenario before the end of its worker becomes its failure."""

RECYCLE = 25
"""Scenarios after which a worker is replaced: the physics engine's memory grows with every reset."""

PATIENCE_S = 600.0
"""A worker that takes longer over one scenario is taken for stuck or stopped: it is killed and replaced."""

POLL_S = 0.5
_ENVIRONMENT = {
    "PYTHONHASHSEED": "0",  # the same order of sets in every worker
    "OMP_NUM_THREADS": "1",  # one core per worker, and sums in one order
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}


class Pool:
    """Worker processes for one setting.

    Args:
        setting: what the workers get.
        size: how many.
        patience_s: wall-clock seconds that a scenario may take.
        recycle: scenarios after which a worker is replaced.
        work: what a worker does.
    """

    def __init__(
        self,
        setting: Setting,
        size: int,
        patience_s: float = PATIENCE_S,
        recycle: int = RECYCLE,
        work: Serve = serve,
    ) -> None:
        self.setting, self.size, self.patience_s, self.recycle, self.work = setting, size, patience_s, recycle, work
        self.workers: dict[Connection, _Worker] = {}

    def run(self, tasks: Sequence[Task]) -> Generator[tuple[Task, Answer], None, None]:
        """Runs all tasks; yields each with its answer, in the order in which they finish.

        All workers have ended when the iterator is exhausted or closed.

        Raises:
            Interrupted: this process was asked to stop.
        """
        queue, tries = deque(tasks), Counter[Task]()
        try:
            while queue or any(worker.task for worker in self.workers.values()):
                interrupts.check()
                self._hand_out(queue)
                for worker, answer in self._answers():
                    task = worker.task
                    assert task is not None
                    worker.task = None
                    if isinstance(answer, str):
                        self._remove(worker)
                        tries[task] += 1
                        if tries[task] < TRIES:
                            queue.appendleft(task)
                            continue
                        answer = Failure(f"its worker {answer}, {TRIES} times")
                    elif worker.done >= self.recycle:
                        self._remove(worker)
                    yield task, answer
        finally:
            for worker in list(self.workers.values()):
                worker.close()
            for worker in list(self.workers.values()):
                self._remove(worker)

    def _hand_out(self, queue: deque[Task]) -> None:
        busy = sum(worker.task is not None for worker in self.workers.values())
        while len(self.workers) < min(self.size, busy + len(queue)):
            worker = _Worker(self.work, self.setting)
            self.workers[worker.connection] = worker
        for worker in self.workers.values():
            if worker.task is None and queue:
                worker.give(queue.popleft())

    def _answers(self) -> Iterator[tuple[_Worker, Any]]:
        """The answers of workers at work; a string is the end of one that died or did not answer in time."""
        for connection in wait(list(self.workers), timeout=POLL_S):
            worker = self.workers[connection]  # type: ignore[index]
            answer = worker.answer()
            if worker.task is not None:
                yield worker, answer
            else:  # it died while it had nothing to do
                self._remove(worker)
        for worker in list(self.workers.values()):
            if worker.task is not None and time.monotonic() - worker.since > self.patience_s:
                worker.process.kill()
                yield worker, f"did not answer for {self.patience_s:g} seconds"

    def _remove(self, worker: _Worker) -> None:
        self.workers.pop(worker.connection, None)
        worker.end()


class _Worker:
    def __init__(self, work: Serve, setting: Setting) -> None:
        # a fresh interpreter: a fork would take threads and GPU memory of this process along
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.task: Task | None = None
        self.since, self.done = 0.0, 0
        self.process = context.Process(target=work, args=(theirs, setting), daemon=True)
        with theirs, _environment():
            self.process.start()

    def give(self, task: Task) -> None:
        self.task, self.since = task, time.monotonic()
        with contextlib.suppress(OSError):  # it is dead: the next read from it tells
            self.connection.send(task)

    def answer(self) -> Answer | str:
        """What it sent, or how it died."""
        try:
            found: Answer = self.connection.recv()
        except (EOFError, OSError):
            self.process.join(timeout=5)
            code = self.process.exitcode
            if code is None:
                return "closed its connection"
            if code == -9:
                return "was killed, perhaps for lack of memory"
            return f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
        self.done += 1
        return found

    def close(self) -> None:
        """Asks the process to end."""
        self.connection.close()
        if self.task is not None:
            self.process.terminate()

    def end(self) -> None:
        """Waits for the process to end, killing it after a few seconds or at once if it is at work."""
        self.connection.close()
        self.process.join(timeout=0 if self.task is not None else 5)
        if self.process.is_alive():
            self.process.kill()
        self.process.join()


@contextlib.contextmanager
def _environment() -> Iterator[None]:
    """What a process inherits that is started inside."""
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
