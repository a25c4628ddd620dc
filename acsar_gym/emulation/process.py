"""Runs the emulator in another process, which ends with this one."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from typing import NamedTuple

from acsar_gym.errors import LinkError

END_TIMEOUT = 30.0
"""Time after which an emulator that doesn't end is killed [s]."""
ENDING_WITH_US = """
import os, threading

def follow():
    os.read(0, 1)  # returns when the other end of the pipe is closed, or its process has ended
    os._exit(0)

threading.Thread(target=follow, daemon=True).start()
from acsar_gym.cli import main
main()
"""
"""Runs `acsar-gym` and exits when the parent process does, for whatever reason."""


class Devices(NamedTuple):
    """Paths of the emulated devices."""

    robot: str
    lidar: str | None = None


@contextlib.contextmanager
def emulator(*arguments: str) -> Iterator[Devices]:
    """Run `acsar-gym emulate` in another process, as a context manager.

    It ends with the context, or with this process, even if that is killed. Ctrl-C reaches this
    process only.

    Args:
        *arguments: command line arguments of `emulate`; with "--lidar" there are two devices.

    Yields:
        Paths of the emulated devices.

    Raises:
        LinkError: the emulator didn't start.
    """
    command = [sys.executable, "-c", ENDING_WITH_US, "emulate", *arguments]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            robot = _device(process, arguments)
            yield Devices(robot, _device(process, arguments) if "--lidar" in arguments else None)
        finally:
            _end(process)


def _device(process: subprocess.Popen[str], arguments: tuple[str, ...]) -> str:
    """Read the line that names the next device."""
    line = process.stdout.readline() if process.stdout else ""
    device = line.strip().split(" ")[-1]
    if not device.startswith("/"):
        said = f"run 'acsar-gym emulate {' '.join(arguments)}' to see why"
        raise LinkError("the emulator didn't start", said)
    return device


def _end(process: subprocess.Popen[str]) -> None:
    """Terminate the emulator; kill it after END_TIMEOUT."""
    process.terminate()
    try:
        process.wait(END_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.kill()
