"""The entry point: finds the commands, runs one, and makes its errors one line and an exit code."""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import operator
import os
import pkgutil
import shlex
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, Literal, get_args

import tyro

try:
    import termios
except ImportError:  # on Windows
    termios = None  # type: ignore[assignment]

import acsar_gym
from acsar_gym.errors import (
    AcsarError,
    AcsarWarning,
    ConfigError,
    escape_unprintable,
    show_value,
    suggest_name,
)
from acsar_gym.reading import COMMAND
from acsar_gym.streams import print_error, run_guarded
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
    """
    with contextlib.suppress(SystemExit):  # with which tyro ends after printing
        parse_command(["--tyro-print-completion", shell])
    return 0


def parse_command(words: list[str]) -> Any:
    """Run the command of a command line."""
    sections = get_args(CommandSection)
    found: dict[str, Any] = {}
    groups: dict[str, dict[str, Any]] = {}
    for name, one in sorted(COMMANDS.items(), key=lambda item: sections.index(item[1].section)):
        first, _, inner = name.partition(" ")
        found[first] = one.function
        if inner:
            groups.setdefault(first, {})[inner] = one.function
    found |= {name: make_group(functions) for name, functions in groups.items()}
    if words and not words[0].startswith("-") and words[0] not in found:
        raise ConfigError(f"{show_value(words[0])}: no such command{suggest_name(words[0], found)}")
    return tyro.extras.subcommand_cli_from_dict(
        found,
        prog="acsar-gym",
        description=CLI_ABOUT,
        args=join_ros_arguments(words),
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes),
    )


def join_ros_arguments(words: list[str]) -> list[str]:
    """Return a command line in which what is ROS's, from "--ros-args" to "--", is one last word.

    ROS's words begin with dashes, too, and its launch writes them in several places.
    """
    own: list[str] = []
    ros: list[str] = []
    is_ros = False
    for word in words:
        if word == "--ros-args" or (is_ros and word == "--"):
            is_ros = word == "--ros-args"
        else:
            (ros if is_ros else own).append(word)
    return [*own, f"--ros-args={shlex.join(ros)}"] if ros else own


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
    if issubclass(category, AcsarWarning):
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
    words = sys.argv[1:]
    COMMAND.set(_find_name(words))
    with _kept_terminal() if _drives(words) else contextlib.nullcontext():
        code = run_guarded(lambda: _run_words(words))
    sys.exit(2 if report_broken() and not code else code)


def _drives(words: list[str]) -> bool:
    """Whether the command of a command line drives a robot."""
    name = _find_name(words)
    return name in COMMANDS and COMMANDS[name].drives


def _find_name(words: list[str]) -> str:
    """Return the name of the command of a command line, such as "worlds show"; "" for none."""
    return next((n for n in (" ".join(words[:2]), *words[:1]) if n in COMMANDS), "")


def _run_words(words: list[str]) -> int:
    """Run the command of a command line; returns its exit code."""
    try:
        if words == ["--version"]:
            print(f"acsar-gym {acsar_gym.__version__}")
            return 0
        return int(parse_command(words))
    except AcsarError as error:
        print_error(f"acsar-gym: {escape_unprintable(str(error))}")
        return error.exit_code
    except KeyboardInterrupt:
        stopped = ", the wheels were commanded to stop" if _drives(words) else ""
        print_error(f"\nacsar-gym: interrupted{stopped}")
        return 130
    except SystemExit as ended:  # of tyro, after help and for what it can't parse
        if isinstance(ended.code, str):
            print_error(ended.code)
        return ended.code if isinstance(ended.code, int) else int(ended.code is not None)


@contextlib.contextmanager
def _kept_terminal() -> Iterator[None]:
    """Give the terminal back as it was, on any way out but SIGKILL: keys weren't echoed."""
    if termios is None or not os.isatty(0):
        yield
        return
    before = termios.tcgetattr(0)
    from acsar_gym.guard import shutdown  # noqa: PLC0415

    def restore() -> None:
        with contextlib.suppress(OSError, termios.error):
            # In the background it is another program's, which may have changed it.
            if os.tcgetpgrp(0) == os.getpgrp() and termios.tcgetattr(0) != before:
                termios.tcsetattr(0, termios.TCSANOW, before)

    shutdown.call_at_end(restore)
    shutdown.install_handlers()
    try:
        yield
    finally:
        restore()
