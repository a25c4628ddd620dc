"""Runs jobs on a Ray cluster, or on a Ray of this machine's own."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any

import acsar_gym
from acsar_gym.errors import (
    ClusterError,
    ConfigError,
    JobError,
    escape_unprintable,
    require_extra,
    show_value,
)
from acsar_gym.tools.jobs.processes import MAX_RETRIES, J, R, attempt_job, name_job

CLUSTER_TIMEOUT = 5.0
"""How long a cluster may take to answer, and interrupted jobs to close their links [s]."""
MIN_QUEUED_JOBS = 100
"""Jobs that are sent to a cluster at once, at least; its autoscaler counts those that wait."""
START_HINT = "start a cluster with 'ray start --head', or run without --address"


def run_on_cluster(
    function: Callable[[J], R], jobs: Sequence[J], workers: int | None, address: str
) -> Generator[tuple[int, R], None, None]:
    """As `jobs.completed`, on the cluster at `address`."""
    with connect_cluster(address, workers) as ray:
        remote = ray.remote(num_cpus=1, max_retries=MAX_RETRIES)(_attempt_remotely)
        queue = iter(enumerate(jobs))
        most = workers or max(MIN_QUEUED_JOBS, 2 * int(ray.cluster_resources().get("CPU", 1)))
        running: dict[Any, int] = {}
        try:
            while True:
                while len(running) < most and (each := next(queue, None)):
                    running[remote.remote(acsar_gym.__version__, function, each[1])] = each[0]
                if not running:
                    return
                (done,), _ = ray.wait(list(running), num_returns=1)
                number = running.pop(done)
                yield number, _take_result(ray, done, jobs[number])
        finally:
            with contextlib.suppress(ray.exceptions.RayError, ConnectionError, KeyboardInterrupt):
                for each in running:  # interrupts the jobs, which then close their links
                    ray.cancel(each, force=False)
                if running:
                    ray.wait(list(running), num_returns=len(running), timeout=CLUSTER_TIMEOUT)


def _attempt_remotely(version: str, function: Callable[[Any], Any], job: Any) -> Any:
    """Run a job on a machine of the cluster, which must have the same version of this package."""
    if version != acsar_gym.__version__:
        error = ClusterError(
            f"a machine of the cluster has acsar_gym {acsar_gym.__version__}, this one {version}",
            "install the same version everywhere",
        )
        return None, error
    return attempt_job(function, job)


def _take_result(ray: Any, done: Any, job: object) -> Any:
    """Return the result of a finished job, or raise its error."""
    try:
        result, error = ray.get(done)
    except ray.exceptions.WorkerCrashedError as error:
        raise JobError(
            f"{name_job(job)}: ended {MAX_RETRIES + 1} processes: run it with --workers 1 to see "
            "why"
        ) from error
    except ray.exceptions.RayError as failure:
        why = getattr(failure, "cause", None) or failure
        raise JobError(f"{name_job(job)}: {type(why).__name__}: {_shorten(why)}") from failure
    if error is not None:
        raise error
    return result


@contextlib.contextmanager
def connect_cluster(address: str, workers: int | None = None) -> Iterator[Any]:
    """Connect to a cluster, or start one on this machine; yields the module `ray`.

    A connection that exists already is used and kept.

    Args:
        address: "local", "auto", "host:port" or "ray://host:port".
        workers: CPUs of a cluster that is started here; None for all of this machine.

    Raises:
        ClusterError: no cluster answers at the address.
        MissingExtraError: Ray isn't installed.
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
        raise ClusterError(
            f"--address {show_value(address)}: {_shorten(error)}", START_HINT
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
            raise ClusterError(
                f"--address {show_value(address)}: doesn't answer", START_HINT
            ) from error


def _shorten(error: BaseException) -> str:
    """Return the first sentence of an error's message."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    first, _, _ = (lines[0] if lines else type(error).__name__).partition(". ")
    return escape_unprintable(first)[:300]
