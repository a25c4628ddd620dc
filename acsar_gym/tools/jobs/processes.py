"""Runs jobs in several processes of this machine.

Every process has its own pipe and runs one job at a time, so it is always known which job a dead
process was running.
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
from collections.abc import Callable, Generator, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from acsar_gym.errors import AcsarError, JobError, escape_unprintable, show_value

# One attempt at a job, in another process than the one that started it.

J = TypeVar("J")
R = TypeVar("R")
MAX_RETRIES = 3
"""How often a job is run again after the process or machine that ran it died."""


def attempt_job(function: Callable[[J], R], job: J) -> tuple[R | None, AcsarError | None]:
    """Run one job in another process; returns its result, or the error to raise in the first."""
    try:
        return function(job), None
    except AcsarError as error:
        return None, error
    except Exception as error:  # noqa: BLE001 - it is raised where the jobs were started
        return None, JobError(f"{name_job(job)}: {_described(error)}")


def name_job(job: object) -> str:
    """Name a job in an error message."""
    return f"job {show_value(job)}"


def _described(error: Exception) -> str:
    """Describe an unexpected exception in one line, with the line of code that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {escape_unprintable(str(error))}{place}"


CLOSE_TIMEOUT = 5.0
"""How long an interrupted job may take to close its link [s]; its process is killed then."""
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
"""Environment of the processes: together they use the cores already."""


def run_in_processes(
    function: Callable[[J], R], jobs: Sequence[J], workers: int
) -> Generator[tuple[int, R], None, None]:
    """As `jobs.completed`, in up to `workers` processes."""
    waiting = deque(range(len(jobs)))
    deaths: Counter[int] = Counter()
    crew: list[Worker] = []
    try:
        for _ in range(min(workers, len(jobs))):
            crew.append(Worker(function, quiet=bool(crew)))
            crew[-1].give(waiting.popleft(), jobs)
        while busy := _busy(crew):
            for worker in [busy[each] for each in wait(list(busy))]:
                yield from worker.results(waiting, deaths, jobs)
                if waiting:
                    worker.give(waiting.popleft(), jobs)
    finally:
        _end(crew)


class Worker:
    """A process that runs one job at a time; a new one takes its place where it dies.

    Args:
        function: runs a job.
        quiet: whether it doesn't say that it compiles: another process says so already.

    Attributes:
        number: of the job that it runs; None between two jobs.
        connection: can be read when a job is done, or the process is dead.
    """

    def __init__(self, function: Callable[[Any], Any], *, quiet: bool = False) -> None:
        self._function, self._quiet = function, quiet
        self.number: int | None = None
        self._start()

    def _start(self) -> None:
        """Start the process."""
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(
            target=_serve,
            args=(theirs, self._function, self._quiet),
            name="acsar-gym worker",
            daemon=True,
        )
        with _environment(ONE_THREAD):
            self.process.start()
        theirs.close()

    def give(self, number: int, jobs: Sequence[Any]) -> None:
        """Send it a job."""
        self.number = number
        with contextlib.suppress(OSError):  # it is dead, which `results` finds
            self.connection.send(jobs[number])

    def results(
        self, waiting: deque[int], deaths: Counter[int], jobs: Sequence[Any]
    ) -> Iterator[tuple[int, Any]]:
        """Yield the result of its job, or put the job of a dead process back into the queue.

        Raises:
            AcsarError: what the job raised.
            JobError: it was the last try.
        """
        number, self.number = self.number, None
        assert number is not None  # noqa: S101 - only workers with a job are asked
        try:
            result, error = self.connection.recv()
        except (EOFError, OSError, pickle.UnpicklingError):
            deaths[number] += 1
            self._replace(deaths[number], jobs[number])
            waiting.appendleft(number)
            return
        if isinstance(error, AcsarError):
            raise error
        yield number, result

    def _replace(self, deaths: int, job: object) -> None:
        """Start another process after one died; JobError if the job has ended too many."""
        self.end()
        if deaths > MAX_RETRIES:
            raise JobError(
                f"{name_job(job)}: ended {deaths} processes (the last: {_cause(self.process)}): "
                "run it with --workers 1 to see why"
            )
        self._start()

    def ask_to_end(self) -> None:
        """Interrupt its job, which then closes its link."""
        self.connection.close()
        self.process.terminate()

    def end(self) -> None:
        """Wait for the end of the process, and kill it if that takes too long."""
        self.connection.close()
        self.process.join(CLOSE_TIMEOUT)
        self.process.kill()
        self.process.join()


def _busy(crew: Sequence[Worker]) -> dict[Any, Worker]:
    """Return the workers that have a job, by connection."""
    return {worker.connection: worker for worker in crew if worker.number is not None}


def _end(crew: Sequence[Worker]) -> None:
    """End all processes."""
    for worker in crew:
        worker.ask_to_end()
    for worker in crew:
        worker.end()


def _cause(process: Any) -> str:
    """Describe how a process ended."""
    code = process.exitcode
    if code is not None and code < 0:
        with contextlib.suppress(ValueError):
            return f"signal {signal.Signals(-code).name}"
    return f"exit code {code}"


@contextlib.contextmanager
def _environment(changes: dict[str, str]) -> Iterator[None]:
    """Change environment variables inside the block, for the processes started in it."""
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _serve(connection: Connection, function: Callable[[Any], Any], quiet: bool) -> None:
    """Run jobs until the pipe is closed: the body of a process."""
    if quiet:
        logging.getLogger("acsar_gym.jit").setLevel(logging.ERROR)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the first process, too
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    with contextlib.suppress(EOFError, OSError):
        while True:
            connection.send(attempt_job(function, connection.recv()))
