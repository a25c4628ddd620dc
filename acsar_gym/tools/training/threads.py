"""Chooses the number of threads for training, leaving busy cores to other programs.

torch's threads busy-wait for each other after every small operation. If one of them shares its core
with another program, all others wait for it, and two threads are many times slower than one. So
waiting threads are set to sleep, and only as many are started as there are free cores.
"""

from __future__ import annotations

import hashlib
import os
import threading
import time

from acsar_gym.vector.env import check_threads, usable_cores

PROBE_TIME = 0.25
"""Duration of the measurement of free cores [s]."""
_BLOCK = bytes(1 << 18)
"""Data that a measuring thread hashes in one call, which takes 0.2 ms without the GIL."""


def wait_passively() -> None:
    """Make OpenMP threads sleep while they wait, unless OMP_WAIT_POLICY is already set.

    Call it before torch is imported; libraries that are already loaded aren't affected.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def choose_threads(asked: int | None) -> int:
    """Return the number of threads to use.

    Args:
        asked: number that the user asked for; None for the number of free cores.

    Raises:
        ConfigError: `asked` is below 1 or above the number of cores.
    """
    return measure_free_cores() if asked is None else check_threads("--threads", asked)


def measure_free_cores() -> int:
    """Measure how many cores are free, at least 1; takes PROBE seconds."""
    count = usable_cores()
    return 1 if count == 1 else compute_free_cores(count, _share(count))


def compute_free_cores(count: int, share: float) -> int:
    """Compute the number of free cores from a measurement.

    With k busy threads of other programs, n threads on n cores get a share n / (n + k) each.

    Args:
        count: number of cores, and of threads in the measurement.
        share: share of a core that each thread got, 0 to 1.

    Returns:
        Number of free cores, 1 to `count`.
    """
    others = count / max(share, 1e-3) - count
    return max(1, min(count, round(count - others)))


def _share(count: int) -> float:
    """Measure the share of a core that each of `count` busy threads gets, 0 to 1."""
    spent = [0.0] * count
    begin = time.perf_counter()

    def work(number: int) -> None:
        while time.perf_counter() - begin < PROBE_TIME:
            hashlib.sha256(_BLOCK)
        spent[number] = time.thread_time()

    workers = [threading.Thread(target=work, args=(number,)) for number in range(count)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    return sum(spent) / (count * (time.perf_counter() - begin))
