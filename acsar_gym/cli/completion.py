"""Scripts with which a shell completes the command line."""

from __future__ import annotations

import contextlib
import functools
import operator
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import tyro

Commands = Mapping[str, Callable[..., Any]]


def script(shell: str, commands: Commands, groups: Mapping[str, Commands]) -> None:
    """Print the script of a shell, which needs nothing but Python's standard library at TAB.

    Args:
        shell: bash, zsh or fish.
        commands: name and function or class of each command.
        groups: commands that have commands of their own: by name, and then as `commands`.
    """
    nested = {name: _group(name, inner) for name, inner in groups.items()}
    with contextlib.suppress(SystemExit):  # with which tyro ends after printing
        tyro.extras.subcommand_cli_from_dict(
            {**commands, **nested},
            prog="acsar-gym",
            args=["--tyro-print-completion", shell],
            config=(tyro.conf.OmitSubcommandPrefixes,),
        )


def _group(name: str, commands: Commands) -> Callable[..., Any]:
    """Return a function whose only parameter is one of these commands."""

    def group(command: Any) -> None:
        pass

    kinds: list[Any] = [
        Annotated[Any, tyro.conf.subcommand(inner, constructor=function)]
        for inner, function in commands.items()
    ]
    group.__annotations__["command"] = functools.reduce(operator.or_, kinds)
    group.__doc__ = f"Commands of acsar-gym {name}."
    return group
