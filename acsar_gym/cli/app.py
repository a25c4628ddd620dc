"""The table of commands, and the entry point."""

from __future__ import annotations

import io
import os
import signal
import sys
import warnings
from collections.abc import Callable
from typing import Annotated, Any, Literal

import tyro

import acsar_gym
from acsar_gym.cli.benchmark import benchmark
from acsar_gym.cli.bundles import POLICY, policy
from acsar_gym.cli.calibrate import calibrate
from acsar_gym.cli.dashboard import view
from acsar_gym.cli.devices import doctor, drive, emulate, estop
from acsar_gym.cli.gap import compare, gap
from acsar_gym.cli.identify import identify
from acsar_gym.cli.policies import evaluate, export, run, train
from acsar_gym.cli.recording import RECORD, failed, record
from acsar_gym.cli.tools import bench, demo, warm_up
from acsar_gym.cli.worlds import WORLDS, worlds
from acsar_gym.errors import (
    AcsarError,
    PolicyWarning,
    RecordingWarning,
    SafetyWarning,
    printable,
)

FORMAT = warnings.formatwarning
ABOUT = """Simulate, train, measure and drive a skid-steer robot; --version prints the version.

Every command has a --help of its own."""


def completion(shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]) -> int:
    """Print a script with which a shell completes commands and options at TAB.

    For bash: acsar-gym completion bash > ~/.local/share/bash-completion/completions/acsar-gym

    Args:
        shell: which shell.
    """
    from acsar_gym.cli.completion import script  # noqa: PLC0415
    from acsar_gym.training.options import Options  # noqa: PLC0415

    groups = {"policy": POLICY, "record": RECORD, "worlds": WORLDS}
    script(shell, {**COMMANDS, "train": Options}, groups)
    return 0


COMMANDS: dict[str, Callable[..., Any]] = {
    "demo": demo,
    "bench": bench,
    "emulate": emulate,
    "doctor": doctor,
    "identify": identify,
    "calibrate": calibrate,
    "drive": drive,
    "estop": estop,
    "train": train,
    "evaluate": evaluate,
    "run": run,
    "export": export,
    "record": record,
    "view": view,
    "gap": gap,
    "compare": compare,
    "benchmark": benchmark,
    "policy": policy,
    "worlds": worlds,
    "warm-up": warm_up,
    "completion": completion,
}
GROUPS: dict[str, Callable[[], int]] = {
    "policy": policy,
    "record": record,
    "train": train,
    "worlds": worlds,
}
"""Commands that parse their own arguments, as they have subcommands or options of a script."""


def _one_line(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    """Format a warning of this package as one line, and others as usual."""
    if issubclass(category, SafetyWarning | RecordingWarning | PolicyWarning):
        return f"acsar-gym: {printable(str(message))}\n"
    return FORMAT(message, category, filename, lineno, line)


def main() -> None:
    """Run a command; exceptions of this package become one line and an exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # escape what can't be encoded
            stream.reconfigure(errors="backslashreplace")
    warnings.formatwarning = _one_line
    try:
        if sys.argv[1:] == ["--version"]:
            print(f"acsar-gym {acsar_gym.__version__}")
            code = 0
        elif sys.argv[1:2] and sys.argv[1] in GROUPS:
            code = GROUPS[sys.argv[1]]()
        else:
            code = tyro.extras.subcommand_cli_from_dict(
                COMMANDS, prog="acsar-gym", description=ABOUT
            )
        sys.stdout.flush()
    except AcsarError as error:
        print(f"acsar-gym: {printable(str(error))}", file=sys.stderr)
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
    sys.exit(2 if failed() and not code else code)
