"""Work shared among threads."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from acsar_gym.vector.threads import Threads


def test_threads_raise_an_error_of_any_slice_and_end_when_they_are_closed() -> None:
    running = set(threading.enumerate())
    threads = Threads(3)

    def fail(first: int, last: int) -> None:
        if last == 30:
            raise ValueError("the last slice")

    for _ in range(3):
        with pytest.raises(ValueError, match="the last slice"):
            threads.share(fail, 30)
    threads.share(lambda *_: None, 30)
    threads.close()
    threads.close()
    assert set(threading.enumerate()) <= running
    slices: list[tuple[int, int]] = []
    threads.share(lambda first, last: slices.append((first, last)), 9)
    assert slices == [(0, 9)]


def test_threads_finish_if_ctrl_c_comes_between_slices(monkeypatch: pytest.MonkeyPatch) -> None:
    submit = ThreadPoolExecutor.submit
    finished: list[int] = []

    def interrupted_submit(pool: ThreadPoolExecutor, work: Any, first: int, last: int) -> Any:
        if last == 30:
            raise KeyboardInterrupt
        return submit(pool, work, first, last)

    def work(first: int, last: int) -> None:
        time.sleep(0.1)
        finished.append(last)

    monkeypatch.setattr(ThreadPoolExecutor, "submit", interrupted_submit)
    threads = Threads(3)
    with pytest.raises(KeyboardInterrupt):
        threads.share(work, 30)
    assert finished == [20]
    threads.close()


FORK = """
import os, sys
from acsar_gym.vector.threads import Threads
threads = Threads(3)
def total(first, last):
    done.append(last - first)
done = []
threads.share(total, 90)
if os.fork() == 0:
    done = []
    threads.share(total, 90)
    os._exit(0 if sum(done) == 90 else 1)
sys.exit(os.waitstatus_to_exitcode(os.wait()[1]))
"""


def test_threads_of_a_forked_child() -> None:
    done = subprocess.run([sys.executable, "-c", FORK], check=False, timeout=60)
    assert done.returncode == 0
