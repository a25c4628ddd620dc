"""Runs independent jobs in this process, in several processes, or on a Ray cluster.

    for number, result in completed(function, jobs, workers=4): ...

Evaluations, the benchmark and trainings of several seeds all go through `completed`, so that each
runs on as many cores and machines as there are, with the same results.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable

from acsar_gym.errors import ConfigError, show_value
from acsar_gym.tools.jobs.processes import J, R

__all__ = ["completed"]
MAX_WORKERS = 1024
"""Most processes of one machine."""


def completed(
    function: Callable[[J], R],
    jobs: Iterable[J],
    *,
    workers: int | None = None,
    address: str | None = None,
) -> Generator[tuple[int, R], None, None]:
    """Run `function` on every job and yield the results in order of completion.

    One worker without an address is this process. The job of a process or machine that dies is run
    again, at most `processes.MAX_RETRIES` times. Closing the iterator ends running jobs.

    Args:
        function: can be imported from where it is defined: no lambda and no closure.
        jobs: plain values, such as frozen dataclasses; they are pickled.
        workers: most jobs at a time; None means 1, and with an address one per CPU.
        address: of a Ray cluster: "local" starts one here; "auto", "host:port", "ray://host:port".

    Yields:
        Number of a job, from 0 on, and its result.

    Raises:
        ConfigError: `workers` or `address` can't be used.
        ClusterError: no cluster answers at the address.
        JobError: a job ended every process that ran it, or raised another error than AcsarErrors,
            which are raised as they are; in this process, all are.
    """
    if workers is not None and not 1 <= workers <= MAX_WORKERS:
        raise ConfigError(f"--workers {show_value(workers)}: must be 1 to {MAX_WORKERS:,}")
    listed = list(jobs)
    if not listed or (address is None and workers in (None, 1)):
        return ((number, function(job)) for number, job in enumerate(listed))
    if address is not None:
        from acsar_gym.tools.jobs import cluster  # noqa: PLC0415

        return cluster.run_on_cluster(function, listed, workers, address)
    from acsar_gym.tools.jobs import processes  # noqa: PLC0415

    return processes.run_in_processes(function, listed, workers or 1)
