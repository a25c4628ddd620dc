"""Run a compiled loop, which holds no GIL, over slices of the robots on several threads.

`concurrent.futures` takes 70 us to hand out one piece of work and to hear of its end, which is a
tenth of a step of a thousand robots; bare queues take 20.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Callable
from queue import SimpleQueue

Work = Callable[[int, int], None]
"""Something to be done for items first to last."""
Order = tuple[int, Work, int, int]
"""The order's number, and its work."""
Report = tuple[int, BaseException | None]
"""The number of the order that is done, and what it raised."""


HEAD_START = 48
"""Items that the caller takes on top of its share, for it begins before the others wake up."""


class Threads:
    """The calling thread and `count` - 1 others, which end with `close` or when this is freed.

    Orders are numbered, and so are the reports on them: a report on a call that was interrupted,
    by Ctrl-C for instance, isn't taken for one on a later call.
    """

    def __init__(self, count: int) -> None:
        self._numbers = itertools.count()
        self._start(count - 1)

    def _start(self, others: int) -> None:
        self._process = os.getpid()
        self._idle = True
        self._orders: list[SimpleQueue[Order | None]] = []
        self._reports: SimpleQueue[Report] = SimpleQueue()
        for _ in range(others):
            orders: SimpleQueue[Order | None] = SimpleQueue()
            self._orders.append(orders)
            threading.Thread(target=_serve, args=(orders, self._reports), daemon=True).start()

    def share(self, work: Work, items: int) -> None:
        """Do the work on contiguous shares of so many items; raises what any share raised.

        When it ends, however it does, no thread works on the items any more; only an interrupt of
        that wait leaves threads at work, until `wait` or the next `share`.
        """
        self.wait()
        threads = len(self._orders) + 1
        lead = min(HEAD_START, items // 8) if threads > 1 else 0
        edges = [0, *(lead + (items - lead) * n // threads for n in range(1, threads + 1))]
        first, *others = itertools.pairwise(edges)
        number = next(self._numbers)
        self._idle = False
        try:
            for orders, other in zip(self._orders, others, strict=True):
                orders.put((number, work, *other))
            work(*first)
            errors = self._errors_of(number)
        except BaseException:  # some may have no order, or have been heard already
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
                orders.put((number, _nothing, 0, 0))  # done once all orders before it are
            self._errors_of(number)
            self._idle = True

    def _errors_of(self, number: int) -> list[BaseException]:
        """What the others raised, once all have reported on this order; older reports are lost."""
        errors, missing = [], len(self._orders)
        while missing:
            done, error = self._reports.get()
            if done == number:
                missing -= 1
                errors += [] if error is None else [error]
        return errors

    def close(self) -> None:
        """End the other threads; the caller goes on alone. Idempotent."""
        self.wait()
        self._end()

    def _end(self) -> None:
        for orders in self._orders:
            orders.put(None)
        self._orders = []

    def __reduce__(self) -> tuple[type[Threads], tuple[int]]:
        """Copies have threads of their own."""
        return Threads, (len(self._orders) + 1,)

    def __del__(self) -> None:
        if hasattr(self, "_orders"):
            self._end()


def _nothing(first: int, last: int) -> None:
    """The work of an order that only tells that all before it are done."""


def _serve(orders: SimpleQueue[Order | None], reports: SimpleQueue[Report]) -> None:
    while (order := orders.get()) is not None:
        number, work, first, last = order
        try:
            work(first, last)
        except BaseException as error:  # noqa: BLE001 - raised again by the caller
            reports.put((number, error))
        else:
            reports.put((number, None))
