"""Run independent jobs in this process, in several processes, or on a Ray cluster.

for number, result in run_jobs(function, jobs, workers=4): ...
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import threading
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from functools import partial
from itertools import islice
from typing import Any, TypeVar

import acsar_gym
from acsar_gym.errors import (
    AcsarError,
    ConfigError,
    LinkError,
    format_error,
    require_extra,
    show_value,
)

J = TypeVar("J")
R = TypeVar("R")
Results = Generator[tuple[int, R], None, None]
MAX_WORKERS = 1024
"""Any number far above the cores of a machine will do."""
MAX_RETRIES = 3
"""How often Ray runs a job again after the machine that ran it died."""
CLUSTER_TIMEOUT = 5.0
"""How long a cluster may take to answer [s]. Ray itself tries for minutes."""
START_HINT = "start a cluster with 'ray start --head', or run without --address"


def run_jobs(
    function: Callable[[J], R],
    jobs: Iterable[J],
    workers: int | None = None,
    address: str | None = None,
) -> Results[R]:
    """Run `function` on every job and yield the results in order of completion.

    One worker without an address is this process. Closing the iterator ends running jobs.

    Args:
        function: Can be imported from where it is defined: no lambda and no closure.
        jobs: Values that can be pickled.
        workers: Most jobs at a time. None means 1, and with an address as many as the cluster has
            CPUs.
        address: Address of a Ray cluster: "local" starts a cluster here. "auto", "host:port",
            "ray://host:port".

    Yields:
        Number of a job, from 0 on, and its result.

    Raises:
        ConfigError: `workers` or `address` can't be used.
        LinkError: No cluster answers at the address.
        AcsarError: A process that ran a job ended, or the job raised an error. An AcsarError of a
            job is raised as it is. In this process, every error is.
    """
    if workers is not None and not 1 <= workers <= MAX_WORKERS:
        raise ConfigError(f"--workers {show_value(workers)}: must be 1 to {MAX_WORKERS:,}")
    # Results come in any order, so each carries its number.
    numbered = list(enumerate(jobs))
    if not numbered or (address is None and workers in (None, 1)):
        return ((number, function(job)) for number, job in numbered)

    call = partial(_run_job, function, acsar_gym.__version__, address)
    if address is None:
        return _run_in_processes(call, numbered, min(workers or 1, len(numbered)))
    return _run_on_cluster(call, numbered, workers or len(numbered), address)


def _run_in_processes(call: Any, jobs: Any, workers: int) -> Results[Any]:
    with require_extra("several processes", "scipy"):
        import joblib  # noqa: PLC0415 - optional
        from joblib.externals.loky.process_executor import BrokenProcessPool  # noqa: PLC0415

    with joblib.parallel_config("loky", n_jobs=workers, inner_max_num_threads=1):
        parallel = joblib.Parallel(return_as="generator_unordered", batch_size=1)
        with _interrupts_ignored():  # as the processes do that start here
            results = parallel(joblib.delayed(call)(*job) for job in jobs)
    try:
        for result in results:  # noqa: UP028 - `yield from` would close it before the `finally`
            yield result
    except BrokenProcessPool as error:
        raise _explain_death(error) from error
    finally:
        # Only here, so that the caller's warnings between two results are shown.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # joblib's, about jobs that are ended
            results.close()


@contextlib.contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Ignore Ctrl-C, also in processes that start inside the block: it reaches them as well.

    They would print where they were interrupted, while they import what their jobs need.
    """
    if threading.current_thread() is not threading.main_thread():  # signals are the main thread's
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def _run_on_cluster(call: Any, jobs: Any, workers: int, address: str) -> Results[Any]:
    with connect_cluster(address, workers) as ray:
        remote = ray.remote(num_cpus=1, max_retries=MAX_RETRIES)(call.func)
        # Only as many jobs as workers are submitted at a time, so that closing ends soon.
        waiting = (remote.remote(*call.args, *job) for job in jobs)
        running = list(islice(waiting, workers))

        try:
            while running:
                (done,), running = ray.wait(running, num_returns=1)
                running += islice(waiting, 1)
                yield ray.get(done)
        except ray.exceptions.RayTaskError as error:
            raise error.cause from error
        except ray.exceptions.RayError as error:
            raise _explain_death(error) from error
        finally:
            with contextlib.suppress(ray.exceptions.RayError, ConnectionError, KeyboardInterrupt):
                for job in running:  # interrupts the jobs, which then close their links
                    ray.cancel(job, force=False)
                if running:
                    ray.wait(running, num_returns=len(running), timeout=CLUSTER_TIMEOUT)


def _run_job(function: Any, version: str, address: str | None, number: int, job: Any) -> Any:
    """Run a job in another process. Every error becomes an error that can be pickled."""
    if address is None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the first process as well
    elif version != acsar_gym.__version__:
        difference = (
            f"a machine of the cluster has acsar_gym {acsar_gym.__version__}, this has {version}"
        )
        raise LinkError(difference, "install the same version everywhere")
    if number:  # the process of the first job reports already that it compiles
        logging.getLogger("acsar_gym.jit").setLevel(logging.ERROR)

    try:
        return number, function(job)
    except AcsarError:
        raise
    except Exception as error:  # noqa: BLE001 - reported with the job
        reason = format_error(error)
        raise AcsarError(f"job {show_value(job)}: {reason}; --workers 1 shows where") from None


def _explain_death(error: BaseException) -> AcsarError:
    reason = f"a process that ran a job ended ({type(error).__name__})"
    return AcsarError(f"{reason}: run it with --workers 1 to see why")


@contextlib.contextmanager
def connect_cluster(address: str, workers: int | None = None) -> Iterator[Any]:
    """Connect to a cluster, or start one of `workers` CPUs here. Yields the module `ray`.

    A connection that exists already is used and kept. Addresses and errors as for `run_jobs`.
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
        cores = min(workers or MAX_WORKERS, os.cpu_count() or 1)
        options |= {"num_cpus": cores, "include_dashboard": False}
    try:
        _check_address(grpc, address)
        ray.init(address=address, **options)
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        problem = f"--address {show_value(address)}: {format_error(error)}"
        raise LinkError(problem, START_HINT) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _check_address(grpc: Any, address: str) -> None:
    """Raise OSError unless something that speaks gRPC, as Ray does, answers soon."""
    place = os.environ.get("RAY_ADDRESS", address) if address == "auto" else address
    if place in ("auto", "local"):
        return  # Ray looks for a cluster of this machine, and soon reports that there is none
    host, _, port = place.removeprefix("ray://").rpartition(":")
    if not host or not port.isdecimal():
        raise ConfigError(
            f"--address {show_value(address)}: must be local, auto, host:port or ray://host:port"
        )
    socket.create_connection((host, int(port)), CLUSTER_TIMEOUT).close()

    # Ray would wait for another program, such as its dashboard, and SIGTERM wouldn't end it.
    with grpc.insecure_channel(f"{host}:{port}") as channel:
        try:
            grpc.channel_ready_future(channel).result(CLUSTER_TIMEOUT)
        except grpc.FutureTimeoutError as error:
            raise ConnectionError("isn't a Ray cluster") from error
