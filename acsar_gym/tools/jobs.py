"""Runs independent jobs in this process, in several processes, or on a Ray cluster.

    for number, result in completed(function, jobs, workers=4): ...

Evaluations, the benchmark and trainings of several seeds all go through `completed`: joblib's loky
on one machine, Ray's tasks on a cluster.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import signal
import traceback
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from typing import Any, TypeVar

import acsar_gym
from acsar_gym.errors import (
    AcsarError,
    ConfigError,
    LinkError,
    escape_unprintable,
    require_extra,
    show_value,
)

J = TypeVar("J")
R = TypeVar("R")
MAX_WORKERS = 1024  # most processes of one machine
MAX_RETRIES = 3  # how often a job of a cluster is run again after the machine that ran it died
CLUSTER_TIMEOUT = 5.0
"""How long a cluster may take to answer, and interrupted jobs to close their links [s]."""
MIN_QUEUED_JOBS = 100
"""Jobs that are sent to a cluster at once, at least; its autoscaler counts those that wait."""
START_HINT = "start a cluster with 'ray start --head', or run without --address"


def completed(
    function: Callable[[J], R],
    jobs: Iterable[J],
    *,
    workers: int | None = None,
    address: str | None = None,
) -> Generator[tuple[int, R], None, None]:
    """Run `function` on every job and yield the results in order of completion.

    One worker without an address is this process. The jobs of a cluster's machine that dies are run
    again, at most `MAX_RETRIES` times. Closing the iterator ends running jobs.

    Args:
        function: can be imported from where it is defined: no lambda and no closure.
        jobs: plain values, such as frozen dataclasses; they are pickled.
        workers: most jobs at a time; None means 1, and with an address one per CPU.
        address: of a Ray cluster: "local" starts one here; "auto", "host:port", "ray://host:port".

    Yields:
        Number of a job, from 0 on, and its result.

    Raises:
        ConfigError: `workers` or `address` can't be used.
        LinkError: no cluster answers at the address.
        AcsarError: A process that ran a job ended, or the job raised an error. An AcsarError of a
            job is raised as it is. In this process, every error is.
    """
    if workers is not None and not 1 <= workers <= MAX_WORKERS:
        raise ConfigError(f"--workers {show_value(workers)}: must be 1 to {MAX_WORKERS:,}")
    listed = list(jobs)
    if not listed or (address is None and workers in (None, 1)):
        return ((number, function(job)) for number, job in enumerate(listed))
    numbered = [(acsar_gym.__version__, function, *pair) for pair in enumerate(listed)]
    if address is None:
        return _collect(_run_in_processes(numbered, min(workers or 1, len(listed))))
    return _collect(_run_on_cluster(numbered, workers, address))


Task = tuple[str, Callable[[Any], Any], int, Any]
Attempts = Generator[tuple[int, Any, AcsarError | None], None, None]


def _collect(attempts: Attempts) -> Generator[tuple[int, Any], None, None]:
    """Yield results, and raise the first error."""
    with contextlib.closing(attempts):
        for number, result, error in attempts:
            if error is not None:
                raise error
            yield number, result


def _run_in_processes(tasks: Sequence[Task], workers: int) -> Attempts:
    """Attempt tasks in processes of this machine."""
    with require_extra("several processes", "scipy"):
        import joblib  # noqa: PLC0415 - optional
        from joblib.externals.loky.process_executor import BrokenProcessPool  # noqa: PLC0415

    with joblib.parallel_config("loky", n_jobs=workers, inner_max_num_threads=1):
        parallel = joblib.Parallel(return_as="generator_unordered", batch_size=1)
        with _ignored_interrupts():  # which the processes inherit
            attempts = parallel(joblib.delayed(_attempt_task)(task) for task in tasks)
    try:
        for attempt in attempts:  # noqa: UP028 - `yield from` would close it before the `finally`
            yield attempt
    except BrokenProcessPool as error:
        raise _explain_death(error) from error
    finally:
        with warnings.catch_warnings():  # of jobs that are ended
            warnings.simplefilter("ignore")
            attempts.close()


def _run_on_cluster(tasks: Sequence[Task], workers: int | None, address: str) -> Attempts:
    """Attempt tasks on a Ray cluster.

    By Ray's own tasks: `ray.util.joblib` tells nothing before the last job has ended, and doesn't
    run the jobs of a dead machine again.
    """
    with connect_cluster(address, workers) as ray:
        remote = ray.remote(num_cpus=1, max_retries=MAX_RETRIES)(_attempt_task)
        most = workers or max(MIN_QUEUED_JOBS, 2 * int(ray.cluster_resources().get("CPU", 1)))
        queue = iter(tasks)
        running: list[Any] = []
        try:
            while True:
                running += [remote.remote(t) for t in itertools.islice(queue, most - len(running))]
                if not running:
                    return
                (done,), running = ray.wait(running, num_returns=1)
                yield ray.get(done)
        except ray.exceptions.RayError as error:
            raise _explain_death(error) from error
        finally:
            with contextlib.suppress(ray.exceptions.RayError, ConnectionError, KeyboardInterrupt):
                for attempt in running:  # interrupts the jobs, which then close their links
                    ray.cancel(attempt, force=False)
                if running:
                    ray.wait(running, num_returns=len(running), timeout=CLUSTER_TIMEOUT)


def _explain_death(error: BaseException) -> AcsarError:
    return AcsarError(
        f"a process that ran a job ended ({type(error).__name__}): run it with --workers 1 to see "
        "why"
    )


@contextlib.contextmanager
def _ignored_interrupts() -> Iterator[None]:
    """Start processes that ignore Ctrl-C, which reaches this one, too; it ends them."""
    try:
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    except ValueError:  # not the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _attempt_task(task: Task) -> tuple[int, Any, AcsarError | None]:
    """Run one job in another process; returns its number and result, or the error to raise."""
    version, function, number, job = task
    if number:  # another process says already that it compiles
        logging.getLogger("acsar_gym.jit").setLevel(logging.ERROR)
    if version != acsar_gym.__version__:
        error = LinkError(
            f"a machine of the cluster has acsar_gym {acsar_gym.__version__}, this one {version}",
            "install the same version everywhere",
        )
        return number, None, error
    try:
        return number, function(job), None
    except AcsarError as error:
        return number, None, error
    except Exception as error:  # noqa: BLE001 - it is raised where the jobs were started
        frames = traceback.extract_tb(error.__traceback__)
        place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
        said = f"{type(error).__name__}: {escape_unprintable(str(error))}{place}"
        return number, None, AcsarError(f"job {show_value(job)}: {said}")


@contextlib.contextmanager
def connect_cluster(address: str, workers: int | None = None) -> Iterator[Any]:
    """Connect to a cluster, or start one of `workers` CPUs here; yields the module `ray`.

    A connection that exists already is used and kept. Addresses and errors as for `completed`.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    with require_extra("--address", "scale"):
        import grpc  # noqa: PLC0415 - optional
        import ray  # noqa: PLC0415 - optional
    if ray.is_initialized():
        yield ray
        return
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address == "local":
        options |= {"num_cpus": workers, "include_dashboard": False}
    else:
        _check_address(grpc, address)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            ray.init(address=address, **options)
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        first, _, _ = (lines[0] if lines else type(error).__name__).partition(". ")
        raise LinkError(
            f"--address {show_value(address)}: {escape_unprintable(first)[:300]}", START_HINT
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _check_address(grpc: Any, address: str) -> None:
    """Check that something like Ray answers soon: Ray itself tries for minutes."""
    place = os.environ.get("RAY_ADDRESS", "auto") if address == "auto" else address
    if place == "auto":
        return  # Ray looks for a cluster of this machine, and soon says that there is none
    place = place.removeprefix("ray://")
    host, _, port = place.rpartition(":")
    if not host or not port.isdecimal():
        raise ConfigError(
            f"--address {show_value(address)}: must be local, auto, host:port or ray://host:port"
        )
    with grpc.insecure_channel(place) as channel:
        try:
            grpc.channel_ready_future(channel).result(timeout=CLUSTER_TIMEOUT)
        except grpc.FutureTimeoutError as error:
            raise LinkError(
                f"--address {show_value(address)}: doesn't answer", START_HINT
            ) from error
