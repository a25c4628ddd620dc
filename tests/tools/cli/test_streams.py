"""Commands whose standard streams are closed, full or no longer read. The terminal after them."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import termios
from pathlib import Path

import psutil
import pytest
from recording_tools import drive

from acsar_gym import RobotConfig
from acsar_gym.testing import wait_until

pytestmark = [pytest.mark.usefixtures("deadline"), pytest.mark.xdist_group(__name__)]

FULL = "acsar-gym: the output can't be written: No space left on device\n"
TOO_LARGE = "acsar-gym: the output can't be written: File too large\n"


def run_in_shell(line: str, folder: Path) -> tuple[int, str]:
    """Run a line of bash. Returns the exit code of its first command, and its standard error."""
    line = line.replace("acsar-gym", f"'{sys.executable}' -m acsar_gym") + "; exit ${PIPESTATUS[0]}"
    command = ["bash", "-c", line]
    done = subprocess.run(command, cwd=folder, stderr=subprocess.PIPE, text=True, check=False)
    return done.returncode, done.stderr


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recording."""
    folder = tmp_path_factory.mktemp("streams")
    drive(folder / "tape.mcap", RobotConfig.preset("acsar"), 5)
    return folder


@pytest.mark.parametrize(
    ("line", "code", "error"),
    [
        ("acsar-gym run 1 0 --link planar >&-", 0, ""),
        ("acsar-gym record info tape.mcap | true", 141, ""),
        ("acsar-gym emulate --duration 0.2 | true", 141, ""),
        ("acsar-gym record info tape.mcap >/dev/full", 2, FULL),
        ("ulimit -f 0; acsar-gym record info tape.mcap >limited.txt", 2, TOO_LARGE),
        ("acsar-gym worlds check missing.yaml 2>/dev/full", 2, ""),
    ],
)
def test_lost_output_ends_a_command_without_a_traceback(
    line: str, code: int, error: str, folder: Path
) -> None:
    assert run_in_shell(line, folder) == (code, error)


@pytest.mark.parametrize(
    ("command", "advice"),
    [
        ("drive --link planar", "give a fixed twist with --linear and --angular"),
        ("run 1 0 --link /dev/acsar-missing", "no terminal to ask on; add --yes"),
    ],
)
def test_a_service_without_streams_gets_advice(command: str, advice: str, folder: Path) -> None:
    code, error = run_in_shell(f"acsar-gym {command} <&- >&-", folder)
    assert (code, error.count("\n")) == (2, 1)
    assert advice in error
    assert run_in_shell(f"acsar-gym {command} <&- >&- 2>&-", folder) == (2, "")


OPEN = """
import os, sys
from acsar_gym.streams import open_streams
open_streams()
sys.exit(10 * os.open(os.devnull, os.O_RDONLY) + os.get_inheritable(1))
"""


def test_no_other_file_gets_the_number_of_a_closed_stream() -> None:
    """For example a robot's port, to which children would write what they print."""
    line = f"'{sys.executable}' -c '{OPEN}' <&- >&- 2>&-"
    code = subprocess.run(["bash", "-c", line], check=False).returncode
    assert code >= 31
    assert code % 10 == 1


@pytest.mark.parametrize("end", ["SIGTERM", "SIGHUP", "q"])
def test_a_terminal_echoes_again_after_every_end_of_a_drive(end: str, folder: Path) -> None:
    command = f"'{sys.executable}' -m acsar_gym drive --link planar"
    shell, terminal = pty.fork()
    if shell == 0:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored if the tests run under nohup
        os.execvp("bash", ["bash", "-c", f"{command}; echo code $?; stty -a; echo done"])  # noqa: S606

    wait_until(lambda: not termios.tcgetattr(terminal)[3] & termios.ECHO, "a drive that reads keys")
    if end == "q":
        os.write(terminal, b"q")
    else:
        (program,) = psutil.Process(shell).children()
        program.send_signal(signal.Signals[end])
    output = b""
    while b"done\r\n" not in output:
        output += os.read(terminal, 4096)
    os.waitpid(shell, 0)
    os.close(terminal)

    assert b" echo " in output
    assert (b"code 0\r\n" in output) == (end == "q"), output
