"""How many threads to train with: other programs' share of the processor is left to them.

torch's threads wait for each other after every small operation, spinning. Where one of them has to
share its core, the others spin for as long as it waits, and two threads are many times slower than
one. So they are told to sleep instead, and only as many are started as there are free cores.
"""

from __future__ import annotations

import hashlib
import os
import threading
import time

from acsar_gym.errors import ConfigError

PROBE = 0.25
"""How long the measurement of free cores takes [s]."""
_BLOCK = bytes(1 << 18)
"""What a thread of the measurement hashes at once, without the GIL: about 0.2 ms of work."""


def wait_passively() -> None:
    """Have OpenMP's threads sleep while they wait, unless the user's environment says how.

    Only what is loaded afterwards heeds it: call it before torch is imported.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def cores() -> int:
    """How many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def chosen(asked: int | None) -> int:
    """The number asked for, or as many as there are free cores just now.

    Raises ConfigError for fewer than 1 and for more than there are cores.
    """
    if asked is None:
        return free_cores()
    if not 1 <= asked <= cores():
        raise ConfigError(f"--threads {asked}: must be 1 to {cores()}, the cores of this machine")
    return asked


def free_cores() -> int:
    """How many threads would get a core of their own now, at least 1. Takes PROBE seconds."""
    count = cores()
    return 1 if count == 1 else undisturbed(count, _share(count))


def undisturbed(count: int, share: float) -> int:
    """How many of `count` cores are free, if that many threads got `share` of their time each.

    Beside k busy threads of others, n threads on n cores get n / (n + k) each.
    """
    others = count / max(share, 1e-3) - count
    return max(1, min(count, round(count - others)))


def _share(count: int) -> float:
    """The share of a core that each of `count` busy threads gets, measured."""
    spent = [0.0] * count
    begin = time.perf_counter()

    def work(number: int) -> None:
        while time.perf_counter() - begin < PROBE:
            hashlib.sha256(_BLOCK)
        spent[number] = time.thread_time()

    workers = [threading.Thread(target=work, args=(number,)) for number in range(count)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    return sum(spent) / (count * (time.perf_counter() - begin))
