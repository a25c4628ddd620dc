"""The command line in this process."""

from __future__ import annotations

from collections.abc import Callable

Ended = tuple[int, str, str]
"""Exit code, standard output, standard error."""
Call = Callable[..., Ended]


def assert_one_line(error: str, said: str) -> None:
    assert error.startswith("acsar-gym: ")
    assert error.count("\n") == 1
    assert said in error
