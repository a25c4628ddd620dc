"""Run a compiled loop, which holds no GIL, over slices of the robots on several threads.

`concurrent.futures` needs 70 us to hand out one piece of work and wait for it, which is a tenth of
a step of a thousand robots; plain queues need 20 us.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import NamedTuple

import numpy as np

from acsar_gym.errors import ConfigError, show_value

ROBOTS_PER_THREAD = 256
"""A thread more is used for so many robots; with fewer its start costs more than it saves."""
Work = Callable[[int, int], None]  # a loop over items first to last


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def check_threads(name: str, wanted: int) -> int:
    """Check a number of threads that a user asked for, and return it."""
    usable, all_cores = usable_cores(), os.cpu_count() or 1
    if isinstance(wanted, int | np.integer) and 1 <= wanted <= usable:
        return int(wanted)
    which = "the cores of this machine"
    if usable < all_cores:
        which = (
            f"the cores that this process may use: taskset, a batch system or a container keeps "
            f"it from the others of this machine's {all_cores}"
        )
    most = f"1 to {usable}" if usable > 1 else "1"
    raise ConfigError(f"{name} {show_value(wanted)}: must be {most}, {which}")


def choose_threads(wanted: int | None, robots: int) -> int:
    """Number of threads to use."""
    if wanted is None:
        return max(1, min(usable_cores(), robots // ROBOTS_PER_THREAD))
    return min(check_threads("threads =", wanted), robots)


class Worker(NamedTuple):
    """A thread, the slices that it is to work on, and what each of them raised."""

    thread: threading.Thread
    orders: SimpleQueue[tuple[Work, int, int] | None]
    reports: SimpleQueue[BaseException | None]


class Threads:
    """The calling thread and `count` - 1 others, which end with `close` or when this is freed."""

    def __init__(self, count: int) -> None:
        self._start(count - 1)

    def _start(self, others: int) -> None:
        """Start so many threads."""
        self._process, self._idle = os.getpid(), True
        self._workers: list[Worker] = []
        for _ in range(others):
            orders: SimpleQueue[tuple[Work, int, int] | None] = SimpleQueue()
            reports: SimpleQueue[BaseException | None] = SimpleQueue()
            thread = threading.Thread(target=_serve, args=(orders, reports), daemon=True)
            self._workers.append(Worker(thread, orders, reports))
            thread.start()

    def share(self, work: Work, items: int) -> None:
        """Run a loop over slices of the items, one slice on each thread, and wait for all.

        Also where this raises what a slice has raised, no thread works on the items any more. Only
        Ctrl-C during the wait leaves threads at work, until `wait` or the next `share`.
        """
        self.wait()
        threads = len(self._workers) + 1
        edges = [items * n // threads for n in range(threads + 1)]
        first, *others = itertools.pairwise(edges)
        self._idle = False
        try:
            for worker, part in zip(self._workers, others, strict=True):
                worker.orders.put((work, *part))
            work(*first)
        except BaseException:  # some threads may have no order
            self.wait()
            raise
        errors = [worker.reports.get() for worker in self._workers]
        self._idle = True
        for error in errors:
            if error is not None:
                raise error

    def wait(self) -> None:
        """Wait until no thread works on what an interrupted call has ordered."""
        if self._process != os.getpid():  # a forked child has none of its parent's threads
            self._start(len(self._workers))
        elif not self._idle:
            self._end()
            for worker in self._workers:
                worker.thread.join()
            self._start(len(self._workers))

    def close(self) -> None:
        """End the other threads; later calls run on the calling thread alone. Idempotent."""
        self.wait()
        self._end()
        self._workers = []

    def _end(self) -> None:
        """Let the other threads end after their orders."""
        for worker in self._workers:
            worker.orders.put(None)

    def __reduce__(self) -> tuple[type[Threads], tuple[int]]:
        """Copies and pickles start threads of their own."""
        return Threads, (len(self._workers) + 1,)

    def __del__(self) -> None:
        if hasattr(self, "_workers"):
            self._end()


def _serve(
    orders: SimpleQueue[tuple[Work, int, int] | None], reports: SimpleQueue[BaseException | None]
) -> None:
    """Work on orders until None comes; the body of a thread."""
    while (order := orders.get()) is not None:
        work, first, last = order
        try:
            work(first, last)
        except BaseException as error:  # noqa: BLE001 - raised again by the caller
            reports.put(error)
        else:
            reports.put(None)
