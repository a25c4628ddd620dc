"""The table of commands, the entry point, and completion by a shell."""

from __future__ import annotations

import contextlib
import functools
import io
import operator
import os
import signal
import sys
import warnings
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal

import tyro

import acsar_gym
from acsar_gym.errors import (
    AcsarError,
    PolicyWarning,
    RecordingWarning,
    SafetyWarning,
    escape_unprintable,
)
from acsar_gym.tools.cli import benchmark, devices, policies, recording, sysid, tools, worlds
from acsar_gym.tools.cli.options import report_broken

FORMAT_WARNING = warnings.formatwarning
CLI_ABOUT = """Simulate, train, measure and drive a skid-steer robot; --version prints the version.

Every command has a --help of its own."""
DRIVING_COMMANDS = ("drive", "run", "evaluate", "doctor", "identify", "calibrate")


def make_group(about: str, commands: Mapping[str, Callable[..., Any]]) -> Callable[..., Any]:
    """Return a command that has commands of its own."""

    def group(command: Any) -> Any:
        return command

    kinds: list[Any] = [
        Annotated[Any, tyro.conf.subcommand(name, constructor=function)]
        for name, function in commands.items()
    ]
    kinds.append(Annotated[None, tyro.conf.Suppress])  # one command alone would be no choice
    group.__annotations__["command"] = functools.reduce(operator.or_, kinds)
    group.__doc__ = about
    return group


def print_completion(shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]) -> int:
    """Print a script with which a shell completes commands and options at TAB.

    For bash: acsar-gym completion bash > ~/.local/share/bash-completion/completions/acsar-gym

    Args:
        shell: which shell.
    """
    from acsar_gym.tools.training.plan import TrainingOptions  # noqa: PLC0415

    with contextlib.suppress(SystemExit):  # with which tyro ends after printing
        parse_command({**COMMANDS, "train": TrainingOptions}, ["--tyro-print-completion", shell])
    return 0


GROUPS: dict[str, tuple[str, dict[str, Callable[..., Any]]]] = {
    "policy": (
        "Show what a policy file says about itself: acsar-gym policy show FILE.",
        {"show": policies.show_policy},
    ),
    "record": (
        "Look into recordings, or convert them: acsar-gym record info|export FILE.",
        {"info": recording.describe_recording, "export": recording.export_recording},
    ),
    "worlds": (
        "Draw, check or convert worlds: acsar-gym worlds show|check|convert SOURCE.",
        {
            "show": worlds.show_worlds,
            "check": worlds.check_worlds,
            "convert": worlds.convert_world,
        },
    ),
}
"""Commands that have commands of their own: what they are for, and these."""
COMMANDS: dict[str, Callable[..., Any]] = {
    "demo": tools.show_demo,
    "bench": tools.measure_speed,
    "emulate": devices.emulate_board,
    "doctor": devices.examine_robot,
    "identify": sysid.identify_robot,
    "calibrate": sysid.calibrate_robot,
    "drive": devices.drive_robot,
    "estop": devices.stop_robots,
    "train": policies.train_policy,
    "evaluate": policies.evaluate_policy,
    "run": policies.run_policy,
    "export": policies.convert_policy,
    "view": recording.view_run,
    "gap": sysid.measure_gap,
    "compare": sysid.compare_runs,
    "benchmark": benchmark.run_benchmark,
    **{name: make_group(*group) for name, group in GROUPS.items()},
    "warm-up": tools.warm_up_caches,
    "completion": print_completion,
}


def parse_command(commands: Mapping[str, Callable[..., Any]], words: list[str]) -> Any:
    """Run the command of a command line."""
    return tyro.extras.subcommand_cli_from_dict(
        dict(commands),
        prog="acsar-gym",
        description=CLI_ABOUT,
        args=words,
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes),
    )


def _format_one_line(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    """Format a warning of this package as one line, and others as usual."""
    if issubclass(category, SafetyWarning | RecordingWarning | PolicyWarning):
        return f"acsar-gym: {escape_unprintable(str(message))}\n"
    return FORMAT_WARNING(message, category, filename, lineno, line)


def main() -> None:
    """Run a command; exceptions of this package become one line and an exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # escape what can't be encoded
            stream.reconfigure(errors="backslashreplace")
    warnings.formatwarning = _format_one_line
    words, code = sys.argv[1:], 0
    try:
        if words == ["--version"]:
            print(f"acsar-gym {acsar_gym.__version__}")
        elif words[:1] == ["train"]:  # has options of a script
            code = COMMANDS["train"]()
        else:
            code = parse_command(COMMANDS, words)
        sys.stdout.flush()
    except AcsarError as error:
        print(f"acsar-gym: {escape_unprintable(str(error))}", file=sys.stderr)
        code = error.exit_code
    except KeyboardInterrupt:
        drives = words[:1] and words[0] in DRIVING_COMMANDS
        stopped = ", the wheels were commanded to stop" if drives else ""
        print(f"\nacsar-gym: interrupted{stopped}", file=sys.stderr)
        code = 130
    except BrokenPipeError:  # such as `| head -1`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 128 + signal.SIGPIPE
    sys.exit(2 if report_broken() and not code else code)
