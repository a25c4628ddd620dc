"""Programs that drive, and whatever befalls them: the half of `stopping` that is harmed."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import pty
import random
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import IO

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError
from acsar_gym.links import open_link
from acsar_gym.links.serial import SerialLink
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
    "pid1-term": "SIGTERM to a container's PID 1",
    "pid1-hup": "SIGHUP to a container's PID 1",
    "thread-term": "SIGTERM while a thread drives",
    "thread-hup": "SIGHUP while a thread drives",
    "thread-end": "the program ends while a thread drives",
    "watchdog": "the watchdog is suspended",
}
REPLUGGED = ("unplug", "reset")
CONTAINED = ("pid1-term", "pid1-hup")
"""These need a PID namespace of their own."""
THREADED = ("thread-term", "thread-hup", "thread-end")
SIGNALS = {
    "kill": signal.SIGKILL,
    "fork": signal.SIGKILL,
    "stop": signal.SIGSTOP,
    "pid1-term": signal.SIGTERM,
    "pid1-hup": signal.SIGHUP,
    "thread-term": signal.SIGTERM,
    "thread-hup": signal.SIGHUP,
}
"""What the program is sent."""
TICKS = 30
"""How long the robot drives before the fault, at least."""
JITTER = 0.02
"""The fault comes at any time within two ticks [s]."""
HANG = 5.0
LIFE = 30.0
"""A forked child lives on for so long [s]."""
CLONE_NEWUSER, CLONE_NEWPID, PR_SET_PDEATHSIG = 0x10000000, 0x20000000, 1
"""Linux' numbers, which Python has from 3.12 on."""


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
            if kind in CONTAINED:
                _become_pid_1(mouth)
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


def no_namespace() -> str:
    """Why this process can't have a PID namespace, as a container has one; "" where it can."""
    child = os.fork()
    if child == 0:
        os._exit(_unshare())
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return f"no PID namespace here ({os.strerror(code)})" if code else ""


def _unshare() -> int:
    """Give the next child a PID namespace: 0, or the number of an error."""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.unshare(CLONE_NEWPID) == 0 or libc.unshare(CLONE_NEWUSER | CLONE_NEWPID) == 0:
            return 0
        return ctypes.get_errno()
    except (AttributeError, OSError):  # not Linux
        return errno.ENOSYS


def _become_pid_1(mouth: int) -> None:
    """Go on as PID 1 of a namespace, after a process outside has said which one that is."""
    os.setsid()
    _unshare()
    inner = os.fork()
    if inner == 0:
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        return
    os.write(mouth, f"{inner}\n".encode())
    os.close(mouth)
    status = os.waitstatus_to_exitcode(os.waitpid(inner, 0)[1])
    os._exit(status if status >= 0 else 128 - status)


def _harm(kind: str, program: int, terminal: int, report: IO[str]) -> str:
    """Wait until it drives, do something to it, and say when."""
    first = report.readline().strip()
    if kind in CONTAINED and first.isdecimal():
        program, first = int(first), report.readline().strip()
    if first != "drives":
        return first or "it ended"
    if kind in FAULTS or kind == "thread-end":
        return report.readline().strip() or "it ended"
    time.sleep(random.uniform(0.0, JITTER))
    now = time.monotonic()
    if kind == "terminal":
        os.close(terminal)
    elif kind in SIGNALS:
        os.kill(program, SIGNALS[kind])
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
        if kind in THREADED:
            _drive_in_a_thread(robot, kind, report)
            return
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
        FAULTS[kind](robot)
    if kind in CONTAINED:
        _insist(robot)
    while True:
        _go(robot, 1)


def _drive_in_a_thread(robot: Robot, kind: str, report: IO[str]) -> None:
    """The main thread waits meanwhile, or returns, which ends the program."""
    drives = threading.Event()

    def drive() -> None:
        try:
            robot.activate()
            _go(robot, TICKS)
        except AcsarError as error:
            print(error, file=report)
        drives.set()
        _insist(robot)

    driver = threading.Thread(target=drive, daemon=True)
    driver.start()
    drives.wait()
    print("drives", file=report)
    if kind == "thread-end":
        time.sleep(random.uniform(0.0, JITTER))
        print(repr(time.monotonic()), file=report)
    else:
        driver.join()


def _insist(robot: Robot) -> None:
    """Drive, and drive again after a reset whenever an error has ended an episode."""
    while True:
        with contextlib.suppress(AcsarError):
            robot.activate()
            _go(robot, 1)


def _go(robot: Robot, ticks: int) -> None:
    for _ in range(ticks):
        robot.drive(0.2, 0.0)


def _never_return() -> None:
    while True:
        pass


def _raise() -> None:
    raise RuntimeError("a policy's mistake")


def _suspend_watchdog(robot: Robot) -> None:
    if isinstance(robot.link, SerialLink) and robot.link.watchdog_pid:
        os.kill(robot.link.watchdog_pid, signal.SIGSTOP)


FAULTS: dict[str, Callable[[Robot], None]] = {
    "hang": lambda _: time.sleep(HANG),
    "busy": lambda _: _never_return(),
    "exception": lambda _: _raise(),
    "exit": lambda _: os._exit(1),
    "watchdog": _suspend_watchdog,
}
"""What a policy can do to its own program."""
