"""Requests to stop: raised, noted, deferred, and acted on where Python has swallowed them."""

from __future__ import annotations

import gc
import os
import pickle
import signal
import sys
import threading
import weakref
from collections.abc import Callable
from contextlib import AbstractContextManager

import pytest

from apex_lab.base.interrupts import ALWAYS, IF_FREE, Interrupted, asked, check, deferring, interruptible


def ask(number: int = signal.SIGTERM) -> None:
    os.kill(os.getpid(), number)


class Dying:
    """Asks for a stop while it is destroyed."""

    def __del__(self) -> None:
        ask()
        for _ in range(100):  # the handler runs between these instructions
            pass


class Plain:
    """Can be referred to weakly."""


def in_del() -> None:
    Dying()


def in_callback_of_a_weak_reference() -> None:
    thing = Plain()
    kept = weakref.ref(thing, lambda _: ask())
    del thing
    assert kept() is None


def in_callback_of_the_garbage_collector() -> None:
    def callback(phase: str, info: dict[str, int]) -> None:
        ask()

    gc.callbacks.append(callback)
    try:
        gc.collect()
    finally:
        gc.callbacks.remove(callback)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("happen", [in_del, in_callback_of_a_weak_reference, in_callback_of_the_garbage_collector])
def test_a_swallowed_request_acts_at_the_next_safe_point(happen: Callable[[], None]) -> None:
    reached = []

    def work() -> None:
        with interruptible():
            happen()
            reached.append("swallowed")
            check()
            reached.append("a safe point was passed")

    with pytest.raises(Interrupted) as raised:
        work()
    assert reached == ["swallowed"]
    assert raised.value.signum == signal.SIGTERM


def test_what_a_stopped_library_raises_is_the_request() -> None:
    def work() -> None:
        try:
            ask()
        finally:
            raise AttributeError("half done")

    with pytest.raises(Interrupted), interruptible():
        work()
    with pytest.raises(AttributeError, match="by itself"), interruptible():
        raise AttributeError("by itself")


def test_a_swallowed_request_prints_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", told.append)
    with pytest.raises(Interrupted), interruptible():
        in_del()
    assert told == []


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_without_a_safe_point_it_acts_at_the_end_of_the_block() -> None:
    with pytest.raises(Interrupted), interruptible(), interruptible():
        in_del()
    assert asked() is None


@pytest.mark.parametrize("number", [*ALWAYS, *IF_FREE])
def test_each_signal_raises_with_its_number(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with pytest.raises(Interrupted, match=number.name) as raised, interruptible():
        ask(number)
    assert raised.value.signum == number
    assert signal.getsignal(number) == before
    check()  # what was acted on is forgotten


def test_work_at_hand_defers_a_request_and_a_second_one_stops_at_once(capfd: pytest.CaptureFixture[str]) -> None:
    steps = []

    def once() -> None:
        with interruptible(), deferring():
            ask(signal.SIGUSR1)
            check()
            steps.append(asked())

    def twice() -> None:
        with deferring():
            ask()
            ask(signal.SIGINT)
            steps.append(None)

    with pytest.raises(Interrupted) as raised:
        once()
    assert steps == [signal.SIGUSR1]
    assert raised.value.signum == signal.SIGUSR1
    assert "Stopping when this step is stored" in capfd.readouterr().err
    with pytest.raises(Interrupted) as raised:
        twice()
    assert steps == [signal.SIGUSR1]
    assert raised.value.signum == signal.SIGTERM


def test_a_signal_that_a_scheduler_s_library_handles_is_left_to_it() -> None:
    taken = []
    before = signal.signal(signal.SIGUSR1, lambda *_: taken.append("theirs"))
    try:
        with interruptible():
            ask(signal.SIGUSR1)
            check()
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert taken == ["theirs"]


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 0), (signal.SIGUSR1, 0), (signal.SIGTERM, -15)])
def test_a_forked_child_leaves_the_decision_to_its_parent(number: signal.Signals, status: int) -> None:
    with interruptible(), deferring():
        child = os.fork()
        if child == 0:
            try:
                ask(number)
            finally:
                os._exit(0 if asked() is None else 1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == status


@pytest.mark.parametrize("block", [interruptible, deferring])
def test_another_thread_may_work_inside(block: Callable[[], AbstractContextManager[None]]) -> None:
    done = []

    def work() -> None:
        with block():
            done.append(True)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done == [True]


def test_a_request_survives_the_way_from_another_process() -> None:
    found = pickle.loads(pickle.dumps(Interrupted(signal.SIGTERM)))
    assert (found.signum, str(found)) == (signal.SIGTERM, "SIGTERM")
