"""The commands: arguments and calls. The work is done in other packages.

A command is a function that is marked with `command`. Its arguments are the options, its docstring
is the help, and it returns the exit code. What it needs beyond options is imported inside it, so
that the other commands start quickly.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

F = TypeVar("F", bound=Callable[..., int])


class Command(NamedTuple):
    """A command of `acsar-gym`."""

    function: Callable[..., Any]
    drives: bool
    """Whether it drives a robot, which is stopped if Ctrl-C ends the command."""


COMMANDS: dict[str, Command] = {}
"""The commands by name, such as "worlds show"."""


def command(name: str, *, drives: bool = False) -> Callable[[F], F]:
    """Mark a function as a command."""

    def register(function: F) -> F:
        COMMANDS[name] = Command(function, drives)
        return function

    return register
