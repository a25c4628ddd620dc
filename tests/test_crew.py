"""Work shared among threads."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from acsar_gym.crew import Crew


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


FORK = """
import os, sys
from acsar_gym.crew import Crew
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
