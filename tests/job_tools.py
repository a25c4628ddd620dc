"""Jobs that other processes import."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from acsar_gym.errors import MissingExtraError


@dataclass(frozen=True)
class Job:
    """A number to square, and what else happens meanwhile."""

    number: int
    folder: Path
    deaths: int = 0
    """How many processes it ends before it succeeds."""
    waits: Path | None = None
    """It ends when this file exists."""


def square(job: Job) -> int:
    """Square a number. Leaves a file "start-NUMBER-PID" and, when it is done, "end-NUMBER"."""
    try:
        (job.folder / f"start-{job.number}-{os.getpid()}").touch()
        died = job.folder / f"deaths-{job.number}"
        deaths = len(died.read_text()) if died.exists() else 0
        if deaths < job.deaths:
            died.write_text("x" * (deaths + 1))
            os.kill(os.getpid(), signal.SIGKILL)
        while job.waits is not None and not job.waits.exists():
            time.sleep(0.01)
    finally:
        (job.folder / f"end-{job.number}").touch()
    return job.number**2


def missing(number: int) -> int:
    """Fail with an error whose constructor takes other arguments than its message."""
    raise MissingExtraError("this job", "scale")


def broken(number: int) -> int:
    """Fail with an error that isn't this package's."""
    return 1 // (number - number)


def threads(name: str) -> str:
    """Tell an environment variable of the process."""
    return os.environ.get(name, "")
