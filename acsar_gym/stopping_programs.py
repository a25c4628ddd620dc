"""Programs that drive, and whatever befalls them: the half of `stopping` that is harmed."""

from __future__ import annotations

import contextlib
import os
import pty
import random
import signal
import sys
import time
from collections.abc import Callable
from typing import IO

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError
from acsar_gym.links import open_link
from acsar_gym.robot import Robot

KINDS = {
    "kill": "SIGKILL",
    "fork": "SIGKILL while a forked child lives on",
    "stop": "SIGSTOP",
    "hang": "the policy sleeps for 5 s",
    "busy": "the policy never returns",
    "exception": "the policy raises an exception",
    "exit": "os._exit in the policy",
    "terminal": "the terminal is closed",
    "unplug": "unplug-replug; the program has ended",
    "reset": "unplug-replug; the program resets",
}
REPLUGGED = ("unplug", "reset")
TICKS = 30
"""How long the robot drives before the fault, at least."""
JITTER = 0.02
"""The fault comes at any time within two ticks [s]."""
HANG = 5.0
LIFE = 30.0
"""A forked child lives on for so long [s]."""


def serve(device: str, config: str) -> None:
    """Fork a program for each kind that standard input names, and answer when it was harmed.

    A fork has all imports behind it. What it does afterwards is what a program of its own would do,
    down to the interpreter's end, which is why `_drive` may return or raise from here.
    """
    robot = RobotConfig.model_validate_json(config)
    for line in sys.stdin:
        kind = line.strip()
        ear, mouth = os.pipe()
        program, terminal = pty.fork() if kind == "terminal" else (os.fork(), -1)
        if program == 0:
            os.close(ear)
            _drive(device, robot, kind, mouth)
            return
        os.close(mouth)
        try:
            with open(ear, encoding="ascii") as report:
                print(_harm(kind, program, terminal, report), flush=True)
                sys.stdin.readline()
        finally:
            _end(program)
        print("ended", flush=True)


def _harm(kind: str, program: int, terminal: int, report: IO[str]) -> str:
    """Wait until it drives, do something to it, and say when."""
    first = report.readline().strip()
    if first != "drives":
        return first or "it ended"
    if kind in FAULTS:
        return report.readline().strip() or "it ended"
    time.sleep(random.uniform(0.0, JITTER))
    now = time.monotonic()
    if kind == "terminal":
        os.close(terminal)
    elif kind not in REPLUGGED:
        os.kill(program, signal.SIGSTOP if kind == "stop" else signal.SIGKILL)
    return repr(now)


def _end(program: int) -> None:
    """Kill it and its children, which share its session."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(program, signal.SIGKILL)
    os.waitpid(program, 0)


def _drive(device: str, config: RobotConfig, kind: str, mouth: int) -> None:
    """The program: it drives until it is harmed, or harms itself as `kind` says."""
    if kind != "terminal":
        os.setsid()
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, 2)
    with open(mouth, "w", buffering=1, encoding="ascii") as report:
        robot = Robot(open_link(device, config), config)
        try:
            _drive_until_harmed(robot, kind, report)
        except AcsarError as error:
            print(error, file=report)
        if kind == "reset":
            robot.activate()
            while True:
                robot.drive(0.0, 0.0)


def _drive_until_harmed(robot: Robot, kind: str, report: IO[str]) -> None:
    robot.activate()
    if kind == "fork" and os.fork() == 0:
        time.sleep(LIFE)
        os._exit(0)
    _go(robot, TICKS)
    print("drives", file=report)
    _go(robot, random.randrange(3))
    if kind in FAULTS:
        print(repr(time.monotonic()), file=report)
        FAULTS[kind]()
    while True:
        _go(robot, 1)


def _go(robot: Robot, ticks: int) -> None:
    for _ in range(ticks):
        robot.drive(0.2, 0.0)


def _never_return() -> None:
    while True:
        pass


def _raise() -> None:
    raise RuntimeError("a policy's mistake")


FAULTS: dict[str, Callable[[], None]] = {
    "hang": lambda: time.sleep(HANG),
    "busy": _never_return,
    "exception": _raise,
    "exit": lambda: os._exit(1),
}
"""What a policy can do to its own program."""
