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
from acsar_gym.tools.cli.benchmark import run_benchmark
from acsar_gym.tools.cli.devices import drive_robot, emulate_board, examine_robot, stop_robots
from acsar_gym.tools.cli.policies import (
    POLICY_COMMANDS,
    evaluate_policy,
    export_policy,
    run_policy,
    run_policy_group,
    train_policy,
)
from acsar_gym.tools.cli.recording import RECORD_COMMANDS, report_broken, run_record_group, view_run
from acsar_gym.tools.cli.sysid import calibrate_robot, compare_runs, identify_robot, measure_gap
from acsar_gym.tools.cli.tools import measure_speed, show_demo, warm_up_caches
from acsar_gym.tools.cli.worlds import WORLD_COMMANDS, run_worlds_group

FORMAT_WARNING = warnings.formatwarning
CLI_ABOUT = """Simulate, train, measure and drive a skid-steer robot; --version prints the version.

Every command has a --help of its own."""


def print_completion(shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]) -> int:
    """Print a script with which a shell completes commands and options at TAB.

    For bash: acsar-gym completion bash > ~/.local/share/bash-completion/completions/acsar-gym

    Args:
        shell: which shell.
    """
    from acsar_gym.tools.training.plan import TrainingOptions  # noqa: PLC0415

    groups = {"policy": POLICY_COMMANDS, "record": RECORD_COMMANDS, "worlds": WORLD_COMMANDS}
    print_script(shell, {**COMMANDS, "train": TrainingOptions}, groups)
    return 0


COMMANDS: dict[str, Callable[..., Any]] = {
    "demo": show_demo,
    "bench": measure_speed,
    "emulate": emulate_board,
    "doctor": examine_robot,
    "identify": identify_robot,
    "calibrate": calibrate_robot,
    "drive": drive_robot,
    "estop": stop_robots,
    "train": train_policy,
    "evaluate": evaluate_policy,
    "run": run_policy,
    "export": export_policy,
    "record": run_record_group,
    "view": view_run,
    "gap": measure_gap,
    "compare": compare_runs,
    "benchmark": run_benchmark,
    "policy": run_policy_group,
    "worlds": run_worlds_group,
    "warm-up": warm_up_caches,
    "completion": print_completion,
}
COMMAND_GROUPS: dict[str, Callable[[], int]] = {
    "policy": run_policy_group,
    "record": run_record_group,
    "train": train_policy,
    "worlds": run_worlds_group,
}
"""Commands that parse their own arguments, as they have subcommands or options of a script."""


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
    try:
        if sys.argv[1:] == ["--version"]:
            print(f"acsar-gym {acsar_gym.__version__}")
            code = 0
        elif sys.argv[1:2] and sys.argv[1] in COMMAND_GROUPS:
            code = COMMAND_GROUPS[sys.argv[1]]()
        else:
            code = tyro.extras.subcommand_cli_from_dict(
                COMMANDS, prog="acsar-gym", description=CLI_ABOUT
            )
        sys.stdout.flush()
    except AcsarError as error:
        print(f"acsar-gym: {escape_unprintable(str(error))}", file=sys.stderr)
        code = error.exit_code
    except KeyboardInterrupt:
        driving = sys.argv[1:2] in (
            ["drive"],
            ["run"],
            ["evaluate"],
            ["doctor"],
            ["identify"],
            ["calibrate"],
        )
        stopped = ", the wheels were commanded to stop" if driving else ""
        print(f"\nacsar-gym: interrupted{stopped}", file=sys.stderr)
        code = 130
    except BrokenPipeError:  # such as `| head -1`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 128 + signal.SIGPIPE
    sys.exit(2 if report_broken() and not code else code)


CommandTable = Mapping[str, Callable[..., Any]]


def print_script(shell: str, commands: CommandTable, groups: Mapping[str, CommandTable]) -> None:
    """Print the script of a shell, which needs nothing but Python's standard library at TAB.

    Args:
        shell: bash, zsh or fish.
        commands: name and function or class of each command.
        groups: commands that have commands of their own: by name, and then as `commands`.
    """
    nested = {name: _make_group(name, inner) for name, inner in groups.items()}
    with contextlib.suppress(SystemExit):  # with which tyro ends after printing
        tyro.extras.subcommand_cli_from_dict(
            {**commands, **nested},
            prog="acsar-gym",
            args=["--tyro-print-completion", shell],
            config=(tyro.conf.OmitSubcommandPrefixes,),
        )


def _make_group(name: str, commands: CommandTable) -> Callable[..., Any]:
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
