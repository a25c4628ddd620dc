"""Run a compiled loop, which holds no GIL, over slices of the robots on several threads."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait

import numpy as np

from acsar_gym.errors import ConfigError, show_value

ROBOTS_PER_THREAD = 256
"""With fewer robots for each thread, handing out the work costs more than it saves."""
Work = Callable[[int, int], None]
"""A loop over items, from the first to the one after the last."""


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    # A container or a batch system may allow fewer cores than the machine has.
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def check_threads(name: str, wanted: int) -> int:
    """Check a number of threads that a user has chosen, and return it."""
    usable = usable_cores()
    all_cores = os.cpu_count() or 1
    if isinstance(wanted, int | np.integer) and 1 <= wanted <= usable:
        return int(wanted)

    which = "the cores of this machine"
    if usable < all_cores:
        which = (
            f"the cores that this process may use: taskset, a batch system or a container keeps "
            f"it from using all {all_cores} of this machine"
        )
    limits = f"1 to {usable}" if usable > 1 else "1"
    raise ConfigError(f"{name} {show_value(wanted)}: must be {limits}, {which}")


def choose_threads(wanted: int | None, robots: int) -> int:
    """Number of threads to use."""
    if wanted is None:
        return max(1, min(usable_cores(), robots // ROBOTS_PER_THREAD))
    return min(check_threads("threads =", wanted), robots)


class Threads:
    """The calling thread and `count` - 1 other threads, which end with `close`."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._process = 0
        self._pool: ThreadPoolExecutor | None = None
        self._running: list[Future[None]] = []

    def share(self, work: Work, items: int) -> None:
        """Run a loop over slices of the items, one slice on each thread, and wait for all.

        If a slice raises an error, this raises it after all threads have finished. Only after
        Ctrl-C do threads go on, until `wait` or the next `share`.
        """
        self.wait()
        if self._count == 1:
            work(0, items)
            return
        if self._pool is None:
            self._process = os.getpid()
            self._pool = ThreadPoolExecutor(self._count - 1)

        edges = [items * n // self._count for n in range(self._count + 1)]

        # The caller takes a slice as well, so Ctrl-C interrupts it between two blocks.
        first, *slices = itertools.pairwise(edges)
        self._running = []
        try:
            # One by one, so that Ctrl-C in between leaves no thread that nobody waits for.
            for limits in slices:
                self._running.append(self._pool.submit(work, *limits))
            work(*first)
        finally:
            wait(self._running)
        # Without this, errors of the other threads would be lost.
        for future in self._running:
            future.result()

    def wait(self) -> None:
        """Wait until no thread works on what an interrupted call has shared."""
        if self._process != os.getpid():  # a forked child has none of its parent's threads
            self._pool = None
            self._running = []
        if self._running:
            wait(self._running)

    def close(self) -> None:
        """End the other threads. Later calls run on the calling thread. Idempotent."""
        self.wait()
        if self._pool is not None:
            self._pool.shutdown()
        self._pool = None
        self._count = 1

    def __reduce__(self) -> tuple[type[Threads], tuple[int]]:
        """Copies and pickles start threads of their own."""
        return Threads, (self._count,)
