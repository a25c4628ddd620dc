"""Work shared among threads."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from queue import SimpleQueue
from typing import Any

import pytest

from acsar_gym.vector.threads import Crew


@pytest.mark.parametrize("threads", [1, 2, 3, 7])
def test_every_item_is_done_once(threads: int) -> None:
    crew = Crew(threads)
    done = [0] * 100

    def work(first: int, last: int) -> None:
        for item in range(first, last):
            done[item] += 1

    for _ in range(50):
        crew.share(work, 100)
    crew.close()
    assert done == [50] * 100


def test_an_error_of_any_share_is_raised_and_the_crew_goes_on() -> None:
    crew = Crew(3)

    def fail(first: int, last: int) -> None:
        if last == 30:
            raise ValueError("the last share")

    for _ in range(3):
        with pytest.raises(ValueError, match="the last share"):
            crew.share(fail, 30)
    crew.share(lambda *_: None, 30)
    crew.close()


def test_a_closed_crew_leaves_no_thread_and_works_on_alone() -> None:
    before = threading.active_count()
    crew = Crew(4)
    crew.close()
    crew.close()
    for thread in threading.enumerate():
        if thread is not threading.current_thread() and thread.daemon:
            thread.join(0.2)
    assert threading.active_count() <= before
    seen: list[tuple[int, int]] = []
    crew.share(lambda first, last: seen.append((first, last)), 9)
    assert seen == [(0, 9)]


def test_a_crew_that_is_dropped_leaves_no_thread() -> None:
    before = set(threading.enumerate())
    crew = Crew(3)
    new = [thread for thread in threading.enumerate() if thread not in before]
    assert len(new) == 2
    del crew
    for thread in new:
        thread.join(5.0)
    assert not any(thread.is_alive() for thread in new)


class Interrupted:
    """A queue in which Ctrl-C comes while it is waited for, at the calls with these numbers."""

    def __init__(self, queue: SimpleQueue[Any], *calls: int) -> None:
        self.queue, self.calls, self.call = queue, calls, 0
        self.put = queue.put

    def get(self) -> Any:
        self.call += 1
        if self.call in self.calls:
            raise KeyboardInterrupt
        return self.queue.get()


@pytest.mark.parametrize("old", [False, True], ids=["at once", "after an old report"])
def test_no_thread_works_on_after_an_interrupt(old: bool) -> None:
    """However the wait for the others ends, the next orders wait for the old ones."""
    crew, held, ended = Crew(3), threading.Event(), []

    def slow(first: int, last: int) -> None:
        if first > 0:
            held.wait(60.0)
            ended.append(first)

    if old:
        crew._reports.put((-1, None))
        crew._reports = Interrupted(crew._reports, 2, 3)  # type: ignore[assignment]
    else:
        crew._reports = Interrupted(crew._reports, 1, 2)  # type: ignore[assignment]
    with pytest.raises(KeyboardInterrupt):
        crew.share(slow, 90)
    assert ended == []
    seen: list[int] = []
    threading.Timer(0.05, held.set).start()
    crew.share(lambda first, _: seen.append(len(ended)), 90)
    assert seen == [2, 2, 2]
    crew.close()


def test_an_interrupt_of_the_callers_own_share_waits_for_the_others() -> None:
    crew, ended = Crew(3), []

    def work(first: int, last: int) -> None:
        if first == 0:
            signal.raise_signal(signal.SIGINT)
        ended.append(first)

    for number in range(1, 4):
        with pytest.raises(KeyboardInterrupt):
            crew.share(work, 90)
        assert len(ended) == 2 * number
    crew.close()


def test_an_interrupt_while_orders_are_handed_out_leaves_nothing_behind() -> None:
    crew, done = Crew(3), []
    orders = crew._orders[1]
    put, calls = orders.put, []

    class Once:
        """The second thread's orders: Ctrl-C comes instead of the first one."""

        def put(self, order: Any) -> None:
            calls.append(order)
            if len(calls) == 1:
                raise KeyboardInterrupt
            put(order)

    crew._orders[1] = Once()  # type: ignore[call-overload]
    with pytest.raises(KeyboardInterrupt):
        crew.share(lambda *_: None, 90)
    for _ in range(3):
        crew.share(lambda first, last: done.append(last - first), 90)
    assert sum(done) == 270
    crew.close()


def test_an_old_error_is_not_raised_by_a_later_call() -> None:
    crew = Crew(2)

    def fail(first: int, last: int) -> None:
        if first > 0:
            raise ValueError("of an interrupted call")

    crew._reports = Interrupted(crew._reports, 1, 2)  # type: ignore[assignment]
    with pytest.raises(KeyboardInterrupt):
        crew.share(fail, 90)
    crew.share(lambda *_: None, 90)
    crew.close()


FORK = """
import os, sys
from acsar_gym.vector.threads import Crew
crew = Crew(3)
def total(first, last):
    done.append(last - first)
done = []
crew.share(total, 90)
if os.fork() == 0:
    done = []
    crew.share(total, 90)
    os._exit(0 if sum(done) == 90 else 1)
sys.exit(os.waitstatus_to_exitcode(os.wait()[1]))
"""


def test_a_forked_child_hires_its_own() -> None:
    done = subprocess.run([sys.executable, "-c", FORK], check=False, timeout=60)
    assert done.returncode == 0
