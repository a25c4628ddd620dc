"""Threads that share out loops which run without the GIL.

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


HEAD_START = 48
"""Items that the caller takes on top of its share, for it begins before the others wake up."""


class Crew:
    """The calling thread and `threads` - 1 others, which end with `close` or with the crew."""

    def __init__(self, threads: int) -> None:
        self._hire(threads - 1)

    def _hire(self, others: int) -> None:
        self._process = os.getpid()
        self._orders: list[SimpleQueue[tuple[Work, int, int] | None]] = []
        self._reports: SimpleQueue[BaseException | None] = SimpleQueue()
        for _ in range(others):
            orders: SimpleQueue[tuple[Work, int, int] | None] = SimpleQueue()
            self._orders.append(orders)
            threading.Thread(target=_serve, args=(orders, self._reports), daemon=True).start()

    def share(self, work: Work, items: int) -> None:
        """Do the work on contiguous shares of so many items; raises what any share raised."""
        if self._process != os.getpid():  # a forked child has none of its parent's threads
            self._hire(len(self._orders))
        threads = len(self._orders) + 1
        lead = min(HEAD_START, items // 8) if threads > 1 else 0
        edges = [0, *(lead + (items - lead) * n // threads for n in range(1, threads + 1))]
        first, *others = itertools.pairwise(edges)
        for orders, other in zip(self._orders, others, strict=True):
            orders.put((work, *other))
        try:
            work(*first)
        finally:
            errors = [self._reports.get() for _ in others]
        for error in errors:
            if error is not None:
                raise error

    def close(self) -> None:
        """Send the others home; the caller goes on alone. Twice is once."""
        for orders in self._orders:
            orders.put(None)
        self._orders = []

    def __reduce__(self) -> tuple[type[Crew], tuple[int]]:
        """Copies have threads of their own."""
        return Crew, (len(self._orders) + 1,)

    def __del__(self) -> None:
        if hasattr(self, "_orders"):
            self.close()


def _serve(
    orders: SimpleQueue[tuple[Work, int, int] | None], reports: SimpleQueue[BaseException | None]
) -> None:
    while (order := orders.get()) is not None:
        work, first, last = order
        try:
            work(first, last)
        except BaseException as error:  # noqa: BLE001 - raised again by the caller
            reports.put(error)
        else:
            reports.put(None)
