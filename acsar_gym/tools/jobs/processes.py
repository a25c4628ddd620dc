"""Runs jobs in several processes of this machine.

Every process has its own pipe and runs one job at a time, so it is always known which job a dead
process was running: an executor of `concurrent.futures` ends all of its processes where one dies.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import pickle
import signal
import sys
import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from acsar_gym.errors import AcsarError, JobError, escape_unprintable, show_value

J = TypeVar("J")
R = TypeVar("R")
MAX_RETRIES = 3
"""How often a job is run again after the process or machine that ran it died."""
CLOSE_TIMEOUT = 5.0
"""How long an interrupted job may take to close its link [s]; its process is killed then."""
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Environment variables that are 1 in the processes: together they use the cores already."""


def run_in_processes(
    function: Callable[[J], R], jobs: Sequence[J], workers: int
) -> Generator[tuple[int, R], None, None]:
    """As `jobs.completed`, in up to `workers` processes."""
    waiting, deaths = deque(range(len(jobs))), Counter[int]()
    processes: dict[Connection, Any] = {}
    running: dict[Connection, int] = {}

    def start_process() -> Connection:
        connection, process = _start_process(function, quiet=bool(processes))
        processes[connection] = process
        return connection

    def run_next(connection: Connection) -> None:
        if waiting:
            running[connection] = waiting.popleft()
            with contextlib.suppress(OSError):  # it is dead, which `_receive` notices
                connection.send(jobs[running[connection]])

    try:
        for _ in range(min(workers, len(jobs))):
            run_next(start_process())
        while running:
            for ready in wait(list(running)):
                assert isinstance(ready, Connection)  # noqa: S101 - `wait` takes sockets, too
                number, told = running.pop(ready), _receive(ready)
                if told is None:
                    process = processes.pop(ready)
                    deaths[number] += 1
                    _end_process(ready, process)
                    _check_deaths(jobs[number], deaths[number], process.exitcode)
                    waiting.appendleft(number)
                    run_next(start_process())
                    continue
                yield number, told[0]
                run_next(ready)
    finally:
        for process in processes.values():
            process.terminate()  # interrupts its job, which then closes its link
        for connection, process in processes.items():
            _end_process(connection, process)


def _receive(connection: Connection) -> tuple[Any] | None:
    """Receive the result of a job, or raise its error; None where the process is dead."""
    try:
        result, error = connection.recv()
    except (EOFError, OSError, pickle.UnpicklingError):
        return None
    if error is not None:
        raise error
    return (result,)


def _check_deaths(job: object, deaths: int, code: int | None) -> None:
    """Check that a job may be run again after a process ended with `code`; JobError if not."""
    if deaths > MAX_RETRIES:
        why = f"exit code {code}"
        with contextlib.suppress(ValueError, TypeError):
            why = f"signal {signal.Signals(-(code or 0)).name}"
        raise JobError(
            f"{name_job(job)}: ended {deaths} processes (the last: {why}): run it with --workers 1 "
            "to see why"
        )


def attempt_job(function: Callable[[J], R], job: J) -> tuple[R | None, AcsarError | None]:
    """Run one job in another process; returns its result, or the error to raise in the first."""
    try:
        return function(job), None
    except AcsarError as error:
        return None, error
    except Exception as error:  # noqa: BLE001 - it is raised where the jobs were started
        frames = traceback.extract_tb(error.__traceback__)
        place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
        said = f"{type(error).__name__}: {escape_unprintable(str(error))}{place}"
        return None, JobError(f"{name_job(job)}: {said}")


def name_job(job: object) -> str:
    """Name a job in an error message."""
    return f"job {show_value(job)}"


def _start_process(function: Callable[[Any], Any], *, quiet: bool) -> tuple[Connection, Any]:
    """Start a process; a quiet one doesn't say that it compiles, as another says so already."""
    context = multiprocessing.get_context("spawn")
    connection, theirs = context.Pipe()
    process = context.Process(
        target=_serve_jobs, args=(theirs, function, quiet), name="acsar-gym worker", daemon=True
    )
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        process.start()
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
    theirs.close()
    return connection, process


def _serve_jobs(connection: Connection, function: Callable[[Any], Any], quiet: bool) -> None:
    """Run jobs until the pipe is closed: the body of a process."""
    if "" not in sys.path:
        sys.path.append("")  # modules in the current folder
    if quiet:
        logging.getLogger("acsar_gym.jit").setLevel(logging.ERROR)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the first process, too
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    with contextlib.suppress(EOFError, OSError):
        while True:
            connection.send(attempt_job(function, connection.recv()))


def _end_process(connection: Connection, process: Any) -> None:
    """Wait for the end of a process, and kill it if that takes too long."""
    connection.close()
    process.join(CLOSE_TIMEOUT)
    process.kill()
    process.join()
