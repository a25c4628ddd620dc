"""Jobs, and the choice of where they run."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Generator, Iterable
from typing import TypeVar

from acsar_gym.errors import AcsarError, ConfigError, JobError, printable, shown

J = TypeVar("J")
R = TypeVar("R")
RETRIES = 3
"""How often a job is run again after the process or machine that ran it died."""
MOST_WORKERS = 1024
"""Most processes of one machine."""


def completed(
    function: Callable[[J], R],
    jobs: Iterable[J],
    *,
    workers: int | None = None,
    address: str | None = None,
) -> Generator[tuple[int, R], None, None]:
    """Run `function` on every job and yield the results in order of completion.

    Without an address, the jobs run on this machine: in this process with one worker, otherwise in
    processes that are started for them. With an address they run on a Ray cluster. The job of a
    process or machine that dies is run again, at most RETRIES times. When the iterator is
    closed, or the caller is interrupted, running jobs are ended.

    Args:
        function: can be imported from where it is defined: no lambda and no closure.
        jobs: plain values, such as frozen dataclasses; they are pickled.
        workers: most jobs at a time; None means 1 without an address, and one per CPU of the
            cluster with one.
        address: "local" starts Ray on this machine; "auto", "host:port" and "ray://host:port"
            connect to a cluster.

    Yields:
        Number of a job, from 0 on, and its result.

    Raises:
        ConfigError: `workers` is out of range.
        ClusterError: no cluster answers at the address.
        JobError: a job ends every process that runs it, or raises an exception that isn't an
            AcsarError; those are raised as they are. In this process, all are.
        MissingExtraError: Ray isn't installed, and there is an address.
    """
    if workers is not None and not 1 <= workers <= MOST_WORKERS:
        raise ConfigError(f"--workers {shown(workers)}: must be 1 to {MOST_WORKERS:,}")
    listed = list(jobs)
    if not listed or (address is None and workers in (None, 1)):
        return ((number, function(job)) for number, job in enumerate(listed))
    if address is not None:
        from acsar_gym.scaling import cluster  # noqa: PLC0415 - optional

        return cluster.completed(function, listed, workers, address)
    from acsar_gym.scaling import processes  # noqa: PLC0415 - one process needs none

    return processes.completed(function, listed, workers or 1)


def attempt(function: Callable[[J], R], job: J) -> tuple[R | None, AcsarError | None]:
    """Run one job in another process; returns its result, or the error to raise in the first."""
    try:
        return function(job), None
    except AcsarError as error:
        return None, error
    except Exception as error:  # noqa: BLE001 - it is raised where the jobs were started
        return None, JobError(f"{named(job)}: {_described(error)}")


def named(job: object) -> str:
    """Name a job in an error message."""
    return f"job {shown(job)}"


def _described(error: Exception) -> str:
    """Describe an unexpected exception in one line, with the line of code that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {printable(str(error))}{place}"
