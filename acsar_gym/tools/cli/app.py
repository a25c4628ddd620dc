"""The entry point: finds the commands, runs one, and makes its errors one line and an exit code."""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import operator
import os
import pkgutil
import signal
import sys
import warnings
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, get_args

import tyro

import acsar_gym
from acsar_gym.errors import (
    AcsarError,
    ConfigError,
    PolicyWarning,
    RecordingWarning,
    SafetyWarning,
    TaskWarning,
    WorldWarning,
    escape_unprintable,
    show_value,
    suggest_name,
)
from acsar_gym.tools.cli import commands
from acsar_gym.tools.cli.commands import COMMANDS, CommandSection, command
from acsar_gym.tools.cli.options import report_broken

FORMAT_WARNING = warnings.formatwarning
CLI_ABOUT = """Simulate, train, measure and drive a skid-steer robot; --version prints the version.

Every command has a --help of its own."""


def find_commands() -> None:
    """Import the files of `commands`, which add theirs to `COMMANDS`."""
    for module in pkgutil.iter_modules(commands.__path__):
        importlib.import_module(f"{commands.__name__}.{module.name}")


find_commands()


@command("completion", "shell")
def print_completion(shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]) -> int:
    """Print a script with which a shell completes commands and options at TAB.

    For bash: acsar-gym completion bash > ~/.local/share/bash-completion/completions/acsar-gym

    Args:
        shell: which shell.
    """
    from acsar_gym.tools.training.plan import TrainingOptions  # noqa: PLC0415

    with contextlib.suppress(SystemExit):  # with which tyro ends after printing
        parse_command(["--tyro-print-completion", shell], train=TrainingOptions)
    return 0


def parse_command(words: list[str], **others: Any) -> Any:
    """Run the command of a command line.

    Args:
        words: the command line.
        **others: functions instead of those of `COMMANDS`, by the command's name.

    Raises:
        ConfigError: there is no such command.
    """
    sections = get_args(CommandSection)
    found: dict[str, Any] = {}
    groups: dict[str, dict[str, Any]] = {}
    for name, one in sorted(COMMANDS.items(), key=lambda item: sections.index(item[1].section)):
        first, _, inner = name.partition(" ")
        found[first] = one.function
        if inner:
            groups.setdefault(first, {})[inner] = one.function
    found |= {name: make_group(functions) for name, functions in groups.items()} | others
    if words and not words[0].startswith("-") and words[0] not in found:
        raise ConfigError(f"{show_value(words[0])}: no such command{suggest_name(words[0], found)}")
    return tyro.extras.subcommand_cli_from_dict(
        found,
        prog="acsar-gym",
        description=CLI_ABOUT,
        args=words,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes),
    )


def make_group(functions: Mapping[str, Callable[..., Any]]) -> Callable[..., Any]:
    """Return a command that has these commands of its own, of one module, by their names."""

    def group(command: Any) -> Any:
        return command

    kinds: list[Any] = [
        Annotated[Any, tyro.conf.subcommand(name, constructor=function)]
        for name, function in functions.items()
    ]
    kinds.append(Annotated[None, tyro.conf.Suppress])  # one command alone would be no choice
    group.__annotations__["command"] = functools.reduce(operator.or_, kinds)
    group.__doc__ = sys.modules[next(iter(functions.values())).__module__].__doc__
    return group


def _format_one_line(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    """Format a warning of this package as one line, and others as usual."""
    kinds = SafetyWarning | RecordingWarning | PolicyWarning | TaskWarning | WorldWarning
    if issubclass(category, kinds):
        return f"acsar-gym: {escape_unprintable(str(message))}\n"
    return FORMAT_WARNING(message, category, filename, lineno, line)


def main() -> None:
    """Run a command; exceptions of this package become one line and an exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # escape what can't be encoded
            stream.reconfigure(errors="backslashreplace")
    warnings.formatwarning = _format_one_line
    if "" not in sys.path:
        sys.path.append("")  # a user's modules are in the current folder
    words, code = sys.argv[1:], 0
    try:
        if words == ["--version"]:
            print(f"acsar-gym {acsar_gym.__version__}")
        elif words[:1] == ["train"]:  # has options of a script
            code = COMMANDS["train"].function()
        else:
            code = parse_command(words)
        sys.stdout.flush()
    except AcsarError as error:
        print(f"acsar-gym: {escape_unprintable(str(error))}", file=sys.stderr)
        code = error.exit_code
    except KeyboardInterrupt:
        named = COMMANDS.get(" ".join(words[:2])) or COMMANDS.get(" ".join(words[:1]))
        drives = named is not None and named.drives
        stopped = ", the wheels were commanded to stop" if drives else ""
        print(f"\nacsar-gym: interrupted{stopped}", file=sys.stderr)
        code = 130
    except BrokenPipeError:  # such as `| head -1`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 128 + signal.SIGPIPE
    sys.exit(2 if report_broken() and not code else code)
