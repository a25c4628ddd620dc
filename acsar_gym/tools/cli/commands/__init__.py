"""The commands: arguments and calls, the work is done elsewhere.

A command is a function that is marked with `command`. Its arguments are the options, its docstring
is the help, and it returns the exit code. What it needs beyond options is imported inside of it, so
that the others start quickly.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeVar

F = TypeVar("F", bound=Callable[..., int])
CommandSection = Literal["first steps", "robots", "policies", "recordings", "worlds", "shell"]
"""Parts of the list of commands that `acsar-gym --help` prints, in their order."""


class Command(NamedTuple):
    """A command of `acsar-gym`."""

    function: Callable[..., Any]
    section: CommandSection
    drives: bool
    """Whether it drives a robot, which is stopped where Ctrl-C ends the command."""


COMMANDS: dict[str, Command] = {}
"""The commands by name; "worlds show" is one of the group `worlds`."""


def command(name: str, section: CommandSection, *, drives: bool = False) -> Callable[[F], F]:
    """Mark a function as a command."""

    def register(function: F) -> F:
        COMMANDS[name] = Command(function, section, drives)
        return function

    return register
