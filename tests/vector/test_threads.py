"""Work shared among threads."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from acsar_gym.vector.threads import Threads


def test_an_error_of_any_share_is_raised_and_the_pool_goes_on() -> None:
    pool = Threads(3)

    def fail(first: int, last: int) -> None:
        if last == 30:
            raise ValueError("the last share")

    for _ in range(3):
        with pytest.raises(ValueError, match="the last share"):
            pool.share(fail, 30)
    pool.share(lambda *_: None, 30)
    pool.close()


def test_a_closed_or_dropped_pool_leaves_no_thread_and_a_closed_one_works_on_alone() -> None:
    before = set(threading.enumerate())
    pool, dropped = Threads(3), Threads(3)
    new = [thread for thread in threading.enumerate() if thread not in before]
    assert len(new) == 4
    del dropped
    pool.close()
    pool.close()
    for thread in new:
        thread.join(5.0)
    assert not any(thread.is_alive() for thread in new)
    seen: list[tuple[int, int]] = []
    pool.share(lambda first, last: seen.append((first, last)), 9)
    assert seen == [(0, 9)]


FORK = """
import os, sys
from acsar_gym.vector.threads import Threads
pool = Threads(3)
def total(first, last):
    done.append(last - first)
done = []
pool.share(total, 90)
if os.fork() == 0:
    done = []
    pool.share(total, 90)
    os._exit(0 if sum(done) == 90 else 1)
sys.exit(os.waitstatus_to_exitcode(os.wait()[1]))
"""


def test_a_forked_child_hires_its_own() -> None:
    done = subprocess.run([sys.executable, "-c", FORK], check=False, timeout=60)
    assert done.returncode == 0
