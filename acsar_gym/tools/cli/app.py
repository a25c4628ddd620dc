"""The entry point: runs a command, and makes its errors one line and an exit code."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import shlex
import sys
import warnings
from collections.abc import Iterator
from typing import Any

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
from acsar_gym.tools.cli.commands import COMMANDS
from acsar_gym.tools.cli.options import report_broken

ABOUT = """\
Simulate, train, measure and drive a skid-steer robot.
Every command has its own --help. --version prints the version."""
FORMAT_WARNING = warnings.formatwarning

# In the order in which `acsar-gym --help` lists their commands.
for module in ("policies", "robots", "fitting", "recordings", "worlds", "ros"):
    importlib.import_module(f"acsar_gym.tools.cli.commands.{module}")


def parse_command(words: list[str]) -> Any:
    """Run the command of a command line. Returns its exit code."""
    wants_help = words[-1:] in (["--help"], ["-h"])
    # All commands, or those of a group such as "worlds".
    prefix = "".join(f"{word} " for word in words[:-1])
    listed = [name for name in COMMANDS if name.startswith(prefix)]
    if not words or (wants_help and listed):
        print(f"usage: acsar-gym {prefix}COMMAND [OPTIONS]\n\n{ABOUT}\n")
        for name in listed:
            print(f"  {name:15} {(COMMANDS[name].function.__doc__ or '').splitlines()[0]}")
        return 0 if words else 2

    name = find_name(words)
    # A group such as "worlds" is no command: its second word is part of the mistyped name.
    if not name:
        is_group = any(name.startswith(f"{words[0]} ") for name in COMMANDS)
        typed = " ".join(words[: 1 + is_group])
        raise ConfigError(f"{show_value(typed)}: no such command{suggest_name(typed, COMMANDS)}")
    # Groups of options are only for --help: their names are no prefixes of options.
    return tyro.cli(
        COMMANDS[name].function,
        prog=f"acsar-gym {name}",
        args=join_ros_arguments(words[len(name.split()) :]),
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )


def find_name(words: list[str]) -> str:
    """Return the name of the command of a command line, such as "worlds show". "" for none."""
    # The commands of a group have names of two words.
    names = (" ".join(words[:2]), *words[:1])
    return next((name for name in names if name in COMMANDS), "")


def join_ros_arguments(words: list[str]) -> list[str]:
    """Join ROS's words, from "--ros-args" to "--", to the last word of a command line.

    They begin with dashes as well, and ROS's launch writes them in several places.
    """
    # tyro takes a list of words that begin with dashes only as one word.
    options: list[str] = []
    ros: list[str] = []
    is_ros = False
    for word in words:
        if word == "--ros-args" or (is_ros and word == "--"):
            is_ros = word == "--ros-args"
        else:
            (ros if is_ros else options).append(word)
    return [*options, f"--ros-args={shlex.join(ros)}"] if ros else options


def main() -> None:
    """Run a command. Exceptions of this package become one line and an exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # escape what can't be encoded
            stream.reconfigure(errors="backslashreplace")
    warnings.formatwarning = _format_warning  # type: ignore[assignment]
    if "" not in sys.path:
        sys.path.append("")  # a user's modules are in the current folder

    # Files that a command writes contain its name, which lets the same command replace them.
    words = sys.argv[1:]
    name = find_name(words)
    COMMAND.set(name)
    drives = name in COMMANDS and COMMANDS[name].drives
    with _kept_terminal() if drives else contextlib.nullcontext():
        code = run_guarded(lambda: _run_words(words, drives=drives))
    sys.exit(2 if report_broken() and not code else code)


def _format_warning(message: Warning | str, category: type[Warning], *place: Any) -> str:
    """Format a warning of this package as one line, and others as usual."""
    if issubclass(category, AcsarWarning):
        return f"acsar-gym: {escape_unprintable(str(message))}\n"
    return FORMAT_WARNING(message, category, *place)


def _run_words(words: list[str], *, drives: bool) -> int:
    """Run the command of a command line. Returns its exit code."""
    if words == ["--version"]:
        print(f"acsar-gym {acsar_gym.__version__}")
        return 0

    try:
        return int(parse_command(words))
    except AcsarError as error:
        print_error(f"acsar-gym: {escape_unprintable(str(error))}")
        return error.exit_code
    except KeyboardInterrupt:
        stopped = ", the wheels were commanded to stop" if drives else ""
        print_error(f"\nacsar-gym: interrupted{stopped}")
        # Shells report 128 + 2 for a program that SIGINT ended.
        return 130
    except SystemExit as end:  # raised by tyro, after help and for options that it can't parse
        if isinstance(end.code, str):
            print_error(end.code)
        return end.code if isinstance(end.code, int) else int(end.code is not None)


@contextlib.contextmanager
def _kept_terminal() -> Iterator[None]:
    """Restore the terminal, in which keys aren't echoed, on every exit path except SIGKILL."""
    if termios is None or not os.isatty(0):
        yield
        return
    settings = termios.tcgetattr(0)
    from acsar_gym.guard import shutdown

    def restore() -> None:
        with contextlib.suppress(OSError, termios.error):
            # In the background the terminal belongs to another program, which may change it.
            if os.tcgetpgrp(0) == os.getpgrp() and termios.tcgetattr(0) != settings:
                termios.tcsetattr(0, termios.TCSANOW, settings)

    shutdown.call_at_end(restore)
    shutdown.install_handlers()
    try:
        yield
    finally:
        restore()
