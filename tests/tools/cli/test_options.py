"""The countdown before wheels turn, on a terminal and without one."""

from __future__ import annotations

import os
import pty
import subprocess
import sys

import pytest
from serial_tools import TIMEOUT

from acsar_gym.errors import ConfigError
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


def counted(seconds: str, keys: bytes) -> str:
    """What a countdown on a terminal says if these keys are pressed."""
    ours, theirs = pty.openpty()
    command = [sys.executable, "-c", COUNTING, seconds]
    with subprocess.Popen(command, stdin=theirs, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            said = process.stdout.readline()
            os.write(ours, keys)
            rest, _ = process.communicate(timeout=TIMEOUT)
        finally:
            process.kill()
            os.close(ours)
            os.close(theirs)
    return said + rest


def test_it_says_what_moves_and_goes_on() -> None:
    said = counted("0.05", b"")
    assert said.startswith("the wheels turn: lift it. Any key cancels.")
    assert said.rstrip().endswith("moves")


@pytest.mark.parametrize("key", [b" ", b"\x1b[A"], ids=["space", "up"])
def test_any_key_cancels(key: bytes) -> None:
    assert counted("1000", key).rstrip().endswith("CancelledError 130")


def test_without_a_terminal_it_names_the_option() -> None:
    with pytest.raises(ConfigError, match="add --yes"):
        countdown("the wheels turn", 0.0)
