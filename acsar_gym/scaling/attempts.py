"""One attempt at a job, in another process than the one that started it."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import TypeVar

from acsar_gym.errors import AcsarError, JobError, printable, shown

J = TypeVar("J")
R = TypeVar("R")
RETRIES = 3
"""How often a job is run again after the process or machine that ran it died."""


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
