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

import numpy as np

from acsar_gym.errors import ConfigError, show_value

ROBOTS_PER_THREAD = 256
"""A thread more is used for so many robots; with fewer its start costs more than it saves."""
Work = Callable[[int, int], None]
"""A loop over items first to last."""
Order = tuple[int, Work, int, int]
"""Number of the order, the loop, and its first and last item."""
OrderReport = tuple[int, BaseException | None]
"""Number of the order that is done, and the exception that it raised."""


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def check_threads(name: str, asked: int) -> int:
    """Check a number of threads that a user asked for, and return it."""
    usable, all_cores = usable_cores(), os.cpu_count() or 1
    if isinstance(asked, int | np.integer) and 1 <= asked <= usable:
        return int(asked)
    which = "the cores of this machine"
    if usable < all_cores:
        which = (
            f"the cores that this process may use: taskset, a batch system or a container keeps "
            f"it from the others of this machine's {all_cores}"
        )
    most = f"1 to {usable}" if usable > 1 else "1"
    raise ConfigError(f"{name} {show_value(asked)}: must be {most}, {which}")


def choose_threads(asked: int | None, robots: int) -> int:
    """Number of threads to use."""
    if asked is None:
        return max(1, min(usable_cores(), robots // ROBOTS_PER_THREAD))
    return min(check_threads("threads =", asked), robots)


class Threads:
    """The calling thread and `count` - 1 others, which end with `close` or when this is freed.

    Orders are numbered, and so are the reports on them: a report on a call that was interrupted,
    by Ctrl-C for instance, isn't taken for one on a later call.
    """

    def __init__(self, count: int) -> None:
        self._numbers = itertools.count()
        self._start(count - 1)

    def _start(self, others: int) -> None:
        """Start so many threads, with new queues."""
        self._process = os.getpid()
        self._idle = True
        self._orders: list[SimpleQueue[Order | None]] = []
        self._reports: SimpleQueue[OrderReport] = SimpleQueue()
        for _ in range(others):
            orders: SimpleQueue[Order | None] = SimpleQueue()
            self._orders.append(orders)
            threading.Thread(target=_serve, args=(orders, self._reports), daemon=True).start()

    def share(self, work: Work, items: int) -> None:
        """Run a loop over slices of the items, one slice on each thread, and wait for all.

        Also where this raises, no thread works on the items any more when it returns. Only Ctrl-C
        during that wait leaves threads at work, until `wait` or the next `share`.

        Args:
            work: called with the first and last item of a slice.
            items: how many.

        Raises:
            BaseException: what any slice raised.
        """
        self.wait()
        threads = len(self._orders) + 1
        edges = [items * n // threads for n in range(threads + 1)]
        first, *others = itertools.pairwise(edges)
        number = next(self._numbers)
        self._idle = False
        try:
            for orders, other in zip(self._orders, others, strict=True):
                orders.put((number, work, *other))
            work(*first)
            errors = self._errors_of(number)
        except BaseException:  # some threads may have no order, or have reported already
            self.wait()
            raise
        self._idle = True
        for error in errors:
            raise error

    def wait(self) -> None:
        """Wait until no thread works on an order of a call that was interrupted."""
        if self._process != os.getpid():  # a forked child has none of its parent's threads
            self._start(len(self._orders))
        if not self._idle:
            number = next(self._numbers)
            for orders in self._orders:
                orders.put((number, lambda *_: None, 0, 0))  # done once all orders before it are
            self._errors_of(number)
            self._idle = True

    def _errors_of(self, number: int) -> list[BaseException]:
        """Wait for the other threads' reports on this order and return their exceptions."""
        errors, missing = [], len(self._orders)
        while missing:
            done, error = self._reports.get()
            if done == number:
                missing -= 1
                errors += [] if error is None else [error]
        return errors

    def close(self) -> None:
        """End the other threads; later calls run on the calling thread alone. Idempotent."""
        self.wait()
        self._end()

    def _end(self) -> None:
        """Tell the other threads to end."""
        for orders in self._orders:
            orders.put(None)
        self._orders = []

    def __reduce__(self) -> tuple[type[Threads], tuple[int]]:
        """Copies and pickles start threads of their own."""
        return Threads, (len(self._orders) + 1,)

    def __del__(self) -> None:
        if hasattr(self, "_orders"):
            self._end()


def _serve(orders: SimpleQueue[Order | None], reports: SimpleQueue[OrderReport]) -> None:
    """Work on orders until None comes; the body of a thread."""
    while (order := orders.get()) is not None:
        number, work, first, last = order
        try:
            work(first, last)
        except BaseException as error:  # noqa: BLE001 - raised again by the caller
            reports.put((number, error))
        else:
            reports.put((number, None))
