"""The countdown before wheels turn, on a terminal and without one."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from types import SimpleNamespace

import pytest
from serial_tools import TIMEOUT

from acsar_gym.errors import CancelledError, ConfigError
from acsar_gym.tools.cli.options import countdown

pytestmark = pytest.mark.usefixtures("deadline")


COUNTING = """
import sys
from acsar_gym.tools.cli.options import countdown
try:
    countdown("the wheels turn: lift it", float(sys.argv[1]))
except Exception as error:
    print(type(error).__name__, error.exit_code)
else:
    print("moves")
"""


def count_down(seconds: str, keys: bytes) -> str:
    """Return the output of a countdown on a terminal while keys are pressed."""
    terminal, child_terminal = pty.openpty()
    command = [sys.executable, "-c", COUNTING, seconds]

    with subprocess.Popen(
        command, stdin=child_terminal, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            first_line = process.stdout.readline()
            os.write(terminal, keys)
            output, _ = process.communicate(timeout=TIMEOUT)
        finally:
            process.kill()
            os.close(terminal)
            os.close(child_terminal)
    return first_line + output


def test_countdown_announces_what_moves_and_ends() -> None:
    output = count_down("0.05", b"")
    assert output.startswith("the wheels turn: lift it. Any key cancels.")
    assert output.rstrip().endswith("moves")


def test_countdown_is_cancelled_by_a_key() -> None:
    assert count_down("1000", b"\x1b[A").rstrip().endswith("CancelledError 130")


def test_countdown_is_cancelled_by_a_key_on_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "termios", None)
    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(kbhit=lambda: True))
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: True))
    with pytest.raises(CancelledError):
        countdown("the wheels turn", 1000.0)


def test_countdown_without_a_terminal_names_the_option() -> None:
    with pytest.raises(ConfigError, match="add --yes"):
        countdown("the wheels turn", 0.0)
