"""Measure how soon wheels are commanded to stop after a fault of the program: `make stopping`.

Three processes take part: the emulator, whose log contains the times of commands, a new program for
each trial, which drives at 100 Hz, and this process, which causes faults. All use the same
monotonic clock. The measured time is from the fault to the first zero command at the emulator,
which polls every 5 ms. While a cable is unplugged no command can arrive, so the time starts when
the cable is plugged in again.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

from processes import Program, first_line, program
from rich.console import Console
from rich.table import Table
from serial_tools import Emulated, start

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError
from acsar_gym.guard.estop import stop_all
from acsar_gym.protocol import ZERO, Decoder
from acsar_gym.testing import EmulatedBoard

LIMIT = 0.25
"""Longest time from a fault to a zero command [s]."""
MAX_STARTS = 3
"""Number of times that a trial is repeated because a busy computer didn't drive the robot."""
FAULT_JITTER = 0.02
"""Faults happen within this time, at any phase of the control loop [s]."""
ZERO_TIMEOUT = 3.0
"""Longest wait for a zero command [s]."""
QUIET_TIME = 1.0
"""Time after a zero command without other commands [s]. A reset takes half of it."""
KINDS = {
    "kill": "the program is killed (SIGKILL)",
    "hang": "the program hangs",
    "exception": "the policy raises an exception",
    "ctrl-c": "Ctrl-C (SIGINT)",
    "thread": "Ctrl-C while a thread drives",
    "term": "SIGTERM",
    "terminal": "the terminal is closed (SIGHUP)",
    "ctrl-z": "Ctrl-Z (SIGTSTP)",
    "estop": "acsar-gym estop in another terminal",
    "cable": "the cable is pulled, then plugged in",
}
OWN_FAULTS = ("hang", "exception")  # kinds that the program causes
SIGNALS = {
    "kill": signal.SIGKILL,
    "ctrl-c": signal.SIGINT,
    "thread": signal.SIGINT,
    "term": signal.SIGTERM,
    "ctrl-z": signal.SIGTSTP,
}
"""Signals that are sent to the program, by kind."""
DRIVING = """
import os, signal, sys, threading, time

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import AcsarError

# As in an interactive shell, however this was started.
signal.signal(signal.SIGINT, signal.default_int_handler)
for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP):
    signal.signal(number, signal.SIG_DFL)

kind, device, robot_file, terminal = sys.argv[1:]
os.setsid()
os.open(terminal, os.O_RDWR)  # which makes it the controlling terminal
config = RobotConfig.load(robot_file)
robot = Robot(open_link(device, config), config)

def drive():
    robot.activate()
    for _ in range(30):
        robot.drive(0.2, 0.0)
    print(repr(time.monotonic()), flush=True)
    if kind == "hang":
        time.sleep(5.0)
    if kind == "exception":
        raise RuntimeError("a policy's mistake")
    while True:
        robot.drive(0.2, 0.0)

if kind == "thread":
    thread = threading.Thread(target=drive)
    thread.start()
    thread.join()
try:
    drive()
except AcsarError:
    if kind != "cable":
        raise
robot.activate()
while True:
    robot.drive(0.0, 0.0)
"""
"""Drives until a fault, which it may cause itself, and prints the time when it drives."""


class Stops(NamedTuple):
    """Times from a kind of fault to the zero command [s]. They are inf if there was none."""

    kind: str
    times: list[float]
    limit: float = LIMIT

    @property
    def is_sound(self) -> bool:
        """Whether all trials were within the limit."""
        return max(self.times) <= self.limit


def list_commands(board: EmulatedBoard) -> Iterator[tuple[float, bool]]:
    """When each command came [s], and whether it turned wheels."""
    decoder = Decoder()
    for event in board.events():
        for reading in decoder.feed(event.get("rx", "").encode("latin-1")):
            yield event["t"], reading.speeds != ZERO


def find_stop(commands: Iterable[tuple[float, bool]], fault: float) -> float:
    """Return when a robot was commanded to stop and not to drive again [s]. inf if it wasn't.

    That is the first zero command after the fault, or the last one if all came before it.

    Args:
        commands: When each came [s], and whether it turned wheels.
        fault: Time of the fault [s].
    """
    zero = math.inf
    for when, turns in commands:
        if turns:
            zero = math.inf
        elif zero == math.inf or zero < fault:
            zero = when
    return zero


def measure(
    trials: int,
    kinds: Sequence[str] = tuple(KINDS),
    config: RobotConfig | None = None,
    board: str | None = None,
) -> Iterator[Stops]:
    """Run trials of each kind of fault on an emulated robot, each with a new program.

    Args:
        trials: Number of trials of each kind.
        kinds: Keys of KINDS.
        config: Robot configuration. None for the ACSAR robot.
        board: Command of another program with the emulator's --log, --name, output and signals.
    """
    with tempfile.TemporaryDirectory(prefix="acsar-stopping-") as folder:
        os.environ.setdefault("ACSAR_GYM_RUNTIME_DIR", folder)  # other robots aren't stopped
        device = Path(folder, "robot")
        robot_file = Path(folder, "robot.yaml")
        RobotConfig.of(config).save(robot_file)
        options = ["--name", str(device)]
        if board is None:
            options += ["--robot", str(robot_file)]
        emulated = start(Path(folder, "log.jsonl"), *options, board=board)
        with contextlib.closing(emulated):
            for kind in kinds:
                times = [_time_stop(kind, emulated, device, robot_file) for _ in range(trials)]
                yield Stops(kind, times)


def _time_stop(kind: str, board: Emulated, device: Path, robot_file: Path) -> float:
    """Run a trial, and return the time from fault to zero command [s].

    It is repeated if the program ended before the fault, or the robot was at rest: on a busy
    computer the watchdog may have stopped it.
    """
    for _ in range(MAX_STARTS):
        board.forget()
        try:
            with faulty_program(kind, board, device, robot_file) as fault:
                zero = _wait_for_stop(board, fault)
        except AcsarError as error:
            problem = error
            continue
        if zero >= fault:
            return zero - fault
        problem = AcsarError(f"{kind}: the robot was at rest before the fault")
    raise problem


@contextlib.contextmanager
def faulty_program(kind: str, board: Emulated, device: Path, robot_file: Path) -> Iterator[float]:
    """Start a program that drives until a fault, as a context manager of the fault's time [s].

    Raises:
        AcsarError: The program didn't drive.
    """
    terminal, slave = os.openpty()
    arguments = (kind, str(device), str(robot_file), os.ttyname(slave))
    with program(DRIVING, *arguments) as process:
        os.close(slave)
        try:
            yield _cause_fault(kind, process, board, terminal)
        finally:
            with contextlib.suppress(OSError):  # it is closed
                os.close(terminal)


def _cause_fault(kind: str, process: Program, board: Emulated, terminal: int) -> float:
    """Cause a fault in a program that drives, and return its time [s]."""
    start_time = first_line(process)
    if not start_time:
        raise AcsarError(f"{kind}: the program didn't drive: {process.communicate()[1]}")
    if kind in OWN_FAULTS:
        return float(start_time)

    time.sleep(random.uniform(0.0, FAULT_JITTER))
    fault = time.monotonic()
    if kind in SIGNALS:
        process.send_signal(SIGNALS[kind])
    elif kind == "terminal":
        os.close(terminal)
    elif kind == "estop":
        stop_all()
    else:
        board.pull()
        time.sleep(random.uniform(0.05, 0.5))
        fault = time.monotonic()
        board.plug()
    return fault


def _wait_for_stop(board: EmulatedBoard, fault: float) -> float:
    """Return the time at which the board was commanded to stop for good [s]. inf if never."""
    zero = math.inf
    now = fault
    while now < fault + ZERO_TIMEOUT + QUIET_TIME and not fault <= zero <= now - QUIET_TIME:
        time.sleep(0.02)
        now = time.monotonic()
        zero = find_stop(list_commands(board), fault)
    return zero


def report(measured: Iterable[Stops]) -> int:
    """Print a table. Return the exit code, 0 if every zero command came in time."""
    columns = ("fault", "min", "median", "max", "in time")
    table = Table(*columns, title="milliseconds from fault to zero command")
    is_sound = True
    for stops in measured:
        cells = [f"{figure(stops.times) * 1000.0:.1f}" for figure in (min, median, max)]
        in_time = sum(duration <= stops.limit for duration in stops.times)
        cells.append(f"{in_time} of {len(stops.times)} within {stops.limit * 1000.0:.0f}")
        table.add_row(stops.kind, *cells)
        # Trials take long, so each row is printed at once.
        print(stops.kind, *cells, sep="  ", file=sys.stderr, flush=True)
        is_sound &= stops.is_sound
    Console().print(table)
    return int(not is_sound)


def main() -> int:
    """Measure, and report the times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=20, help="of each kind of fault")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS), metavar="KIND")
    parser.add_argument("--board", help="command that emulates the board; see `measure`")
    options = parser.parse_args()
    measured = measure(options.trials, options.kinds, board=options.board)
    return report(stops._replace(kind=KINDS[stops.kind]) for stops in measured)


if __name__ == "__main__":
    sys.exit(main())
