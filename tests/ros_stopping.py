"""How soon a robot in ROS stands after a fault of a process: `make ros-stopping`.

Each trial has a program of its own, forked from a process that has imported everything. Measured
are the time from the fault to the first zero command after which none turns wheels, where it
arrives at the robot; and to wheels that stand, which the robot's own motors and time constants add
to. All processes use the same monotonic clock. No ROS daemon runs: nothing here needs one.

The robot is either an emulated board behind `acsar-gym ros driver`, or foreign_robot.py, whose own
time-out of commands is far too long to help. Where the robot's node is lost, the time is that until
the program says so, with one line, and ends.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import math
import os
import random
import select
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import psutil
from nursery import Program, first_line, nursery
from rich.console import Console
from rich.table import Table
from ros_tools import FOREIGN_ROBOT
from serial_tools import HEEDING_CTRL_C, Emulated, start
from stop_times import FAULT_JITTER, LIMIT, MAX_STARTS, find_stop, list_commands

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError
from acsar_gym.testing import wait_until

PRELOADED = ("acsar_gym.tools.cli", "acsar_gym.tools.ros.driver", "acsar_gym.testing", "rclpy")
SIGNALS = {
    "term": signal.SIGTERM,
    "kill": signal.SIGKILL,
    "int": signal.SIGINT,
    "stop": signal.SIGSTOP,
}
OWN_FAULTS = ("exception", "hang")
FAULTS = {
    "term": "SIGTERM",
    "kill": "SIGKILL",
    "int": "Ctrl-C",
    "stop": "SIGSTOP",
    "exception": "an exception",
    "hang": "it sleeps for 5 s",
}
COMMAND_TIMEOUT = 0.5
"""Of the driver's /cmd_vel [s]."""
FOREVER = 1000.0
"""Time-out of a robot that doesn't stop by itself [s]."""
START_TIMEOUT = 60.0
"""Longest wait for a process that starts [s]."""
MARK = "ACSAR_ROS_STOPPING"
"""Environment variable that tells this process's programs from others."""
GRAPH_PAUSE = 2.0
"""Pause before a program is started again because ROS still lists a killed one [s]."""
QUIET_TIME = 0.7
"""Time after a zero command without other commands [s]."""
STOP_TIMEOUT = 3.0
"""Longest wait for wheels that stand [s]."""
SLOW_WHEEL, SLOW_BODY = 0.1, 0.005
"""Wheels [rad/s] and robots [m/s] that are slower stand."""
COMMANDER = """
import signal, sys, time
import rclpy
from geometry_msgs.msg import TwistStamped

signal.signal(signal.SIGINT, signal.default_int_handler)
rclpy.init()
node = rclpy.create_node("commander")
publisher = node.create_publisher(TwistStamped, "cmd_vel", 10)
command = TwistStamped()
command.twist.linear.x = 0.2
while True:
    publisher.publish(command)
    time.sleep(0.05)
"""
DRIVING = """
import signal, sys, time
from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import AcsarError

signal.signal(signal.SIGINT, signal.default_int_handler)
for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP):
    signal.signal(number, signal.SIG_DFL)

def cause(fault):
    if fault == "exception":
        raise RuntimeError("a policy's mistake")
    time.sleep(5.0)

config = RobotConfig.load(sys.argv[1])
robot = Robot(open_link("ros2", config), config)
fault, ticks = sys.argv[2], int(sys.argv[3])
try:
    robot.activate()
    for _ in range(ticks):
        robot.drive(0.2, 0.0)
    print(repr(time.monotonic()), flush=True)
    if fault:
        cause(fault)
    while True:
        robot.drive(0.2, 0.0)
except AcsarError as error:
    print(f"acsar-gym: {error}", file=sys.stderr)
    sys.exit(error.exit_code)
"""
"""Drives until a fault, which it may cause itself; prints the time once it drives."""
INTERRUPTED = """
import signal, sys
from acsar_gym import RobotConfig, open_link
from acsar_gym.wire import Wire
from acsar_gym.worlds import Scene

signal.signal(signal.SIGINT, signal.default_int_handler)
config = RobotConfig.load(sys.argv[1])
link = open_link("ros2", config)
wire = Wire(link, config)
link.open()
link.reset(Scene())
while True:
    try:
        wire.reset()
        print("drives", flush=True)
        while True:
            wire.exchange((4.0, 4.0, 4.0, 4.0))
    except KeyboardInterrupt:
        link.reset(Scene())  # stops the robot, and allows driving again
        print("stopped", flush=True)
"""
"""Drives again after each Ctrl-C."""
POLICY = ("ros", "policy", "--goal", "6.0", "1.0", "--goal-distance", "0.5", "9.0", "--yes",
    "--without-estop")  # fmt: skip


class Kind(NamedTuple):
    """A kind of trial."""

    victim: str
    """Which process has the fault: "driver", "commander", "program", "policy" or
    "robot"."""
    fault: str
    robot: str = "board"

    @property
    def text(self) -> str:
        """What a table calls it."""
        what = {
            "driver": "the driver",
            "commander": "who commands the driver",
            "program": f"a program that drives {ROBOTS[self.robot]}",
            "policy": f"a policy's node that drives {ROBOTS[self.robot]}",
            "robot": f"the node of {ROBOTS[self.robot]}",
        }[self.victim]
        return f"{what}: {FAULTS[self.fault]}"

    @property
    def limit(self) -> float:
        """Longest time allowed [s]."""
        return LIMIT + {"commander": COMMAND_TIMEOUT, "robot": FEEDBACK_TIMEOUT}.get(self.victim, 0)


FEEDBACK_TIMEOUT = 0.5
ROBOTS = {"board": "the driver's robot", "foreign": "a foreign robot"}
KINDS = (
    *(Kind("driver", fault) for fault in SIGNALS),
    Kind("commander", "kill"),
    *(Kind("program", fault, "foreign") for fault in FAULTS),
    *(Kind("program", fault, "board") for fault in ("kill", "int")),
    *(Kind("policy", fault, "foreign") for fault in ("kill", "int")),
    Kind("robot", "kill", "foreign"),
)


@dataclass
class Times:
    """From the faults of one kind to zero commands, and to standing wheels [s]; inf: never."""

    kind: Kind
    zeros: list[float] = field(default_factory=list)
    stands: list[float] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    """What else went wrong."""

    @property
    def sound(self) -> bool:
        """Whether all trials were within the limit, and nothing else went wrong."""
        return not self.problems and all(took <= self.kind.limit for took in self.zeros)


class EmulatedRobot:
    """A board on a pseudo-terminal, for the driver."""

    def __init__(self, folder: Path, file: Path) -> None:
        self.board: Emulated = start(folder / "board.jsonl", "--robot", str(file))

    def commands(self) -> Iterator[tuple[float, bool]]:
        """When each command came [s], and whether it turns wheels."""
        return list_commands(self.board)

    def motion(self) -> Iterator[tuple[float, bool]]:
        """When the robot was looked at [s], and whether it moved."""
        poses = [(event["t"], event["pose"]) for event in self.board.events() if "pose" in event]
        for (before, (x0, y0, _)), (now, (x, y, _)) in itertools.pairwise(poses[::4]):
            yield now, math.hypot(x - x0, y - y0) > SLOW_BODY * (now - before)

    def forget(self) -> None:
        """Begin a new log, with a robot that stands."""
        self.board.forget()

    def close(self) -> None:
        """Switch off."""
        self.board.end()


class ForeignRobot:
    """foreign_robot.py in a process of its own."""

    def __init__(self, folder: Path) -> None:
        self._log = folder / f"foreign{time.monotonic_ns()}.jsonl"
        options = ("--log", str(self._log), "--cmd-vel-timeout", str(FOREVER))
        self.process = subprocess.Popen([sys.executable, str(FOREIGN_ROBOT), *options])
        self._begin = 0
        wait_until(lambda: self._log.exists() and bool(self._read()), "a robot", START_TIMEOUT)

    def _read(self) -> list[dict[str, Any]]:
        with self._log.open("rb") as log:
            log.seek(self._begin)
            lines = log.read().splitlines(keepends=True)
        return [json.loads(line) for line in lines if line.endswith(b"\n")]

    def commands(self) -> Iterator[tuple[float, bool]]:
        """When each command came [s], and whether it turns wheels."""
        for event in self._read():
            if "command" in event:
                yield event["monotonic"], any(event["command"])

    def motion(self) -> Iterator[tuple[float, bool]]:
        """When the robot was looked at [s], and whether it moved."""
        for event in self._read():
            if "speeds" in event:
                yield event["monotonic"], max(map(abs, event["speeds"])) > SLOW_WHEEL

    def forget(self) -> None:
        """Begin a new log."""
        self._begin = self._log.stat().st_size

    def close(self) -> None:
        """Kill it."""
        self.process.kill()
        self.process.wait()

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal to its process."""
        self.process.send_signal(number)


class Trials:
    """Runs trials of any kind; what several need of them lives on, such as the board.

    Args:
        folder: for logs and the robot's file.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._ours = contextlib.ExitStack()
        self._file = folder / "robot.yaml"
        joints = ["right_front", "left_front", "left_rear", "right_rear"]
        config = RobotConfig.preset("acsar").with_(
            connect_timeout=20.0, feedback_timeout=FEEDBACK_TIMEOUT, ros2={"joints": joints}
        )
        self.foreign_file = folder / "foreign.yaml"
        config.with_(control_rate=50.0).save(self.foreign_file)
        config.with_(ros2={}).save(self._file)
        self._robot: EmulatedRobot | ForeignRobot | None = None
        self._driver: Program | None = None
        self._commander: Program | None = None
        self._policy: Program | None = None
        self._program: Program | None = None

    def close(self) -> None:
        """End everything."""
        for victim in ("program", "policy", "commander", "driver", "robot"):
            self._end(victim)

    def run(self, kind: Kind, trials: int) -> Times:
        """Run trials of a kind."""
        times = Times(kind)
        try:
            for _ in range(trials):
                self._run_trial(times)
        finally:
            self.close()
        return times

    def _run_trial(self, times: Times) -> None:
        """Run one trial; again where the robot was stopped before, as on a busy computer."""
        reason = ""
        starts = 0
        while starts < MAX_STARTS:
            try:
                self._cause_and_measure(times)
            except (_NotDrivenError, AcsarError) as error:
                reason = str(error)
                if "another node commands" in reason:  # ROS lists a killed node for a while
                    time.sleep(GRAPH_PAUSE)
                    continue
                self.close()
                starts += 1
            else:
                return
        times.zeros.append(math.inf)
        times.problems.append(f"not driven: {reason}")

    def _cause_and_measure(self, times: Times) -> None:
        kind = times.kind
        robot = self._robot = self._robot or self._make_robot(kind)
        robot.forget()
        if kind.robot == "board":
            self._driver = self._driver or self._start_driver()
        if kind.victim in ("driver", "commander"):
            self._commander = self._commander or Program(COMMANDER)
        elif kind.victim == "policy":
            file = self._file if kind.robot == "board" else self.foreign_file
            self._policy = Program(HEEDING_CTRL_C, *POLICY, "--robot", str(file))
        else:
            self._program = self._start_program(kind)
        try:
            fault = self._cause(kind, robot)
            if kind.victim == "robot":
                self._measure_end(times, fault)
            else:
                self._measure_stop(times, robot, fault)
        finally:
            self._end(kind.victim)
            self._end("program")

    def _end(self, victim: str) -> None:
        """End a process, so that the next trial has a new one."""
        process = getattr(self, f"_{victim}")
        if process is not None:
            process.close()
        setattr(self, f"_{victim}", None)

    def _start_program(self, kind: Kind) -> Program:
        fault = kind.fault if kind.fault in OWN_FAULTS else ""
        file = self._file if kind.robot == "board" else self.foreign_file
        return Program(DRIVING, str(file), fault, str(random.randrange(40, 60)))

    def _cause(self, kind: Kind, robot: EmulatedRobot | ForeignRobot) -> float:
        """Cause the fault in a robot that is driven; returns its time [s]."""
        if self._program is None:
            self._wait_driven(robot)
        elif not (begun := first_line(self._program)):
            raise _NotDrivenError(self._program.communicate()[1])
        time.sleep(random.uniform(0.0, FAULT_JITTER))
        if kind.fault in OWN_FAULTS:
            return float(begun)
        now = time.monotonic()
        getattr(self, f"_{kind.victim}").send_signal(SIGNALS[kind.fault])
        return now

    def _make_robot(self, kind: Kind) -> EmulatedRobot | ForeignRobot:
        if kind.robot == "board":
            return EmulatedRobot(self._folder, self._file)
        return ForeignRobot(self._folder)

    def _start_driver(self) -> Program:
        assert isinstance(self._robot, EmulatedRobot)
        device = self._robot.board.device
        options = ("--link", device, "--robot", str(self._file), "--without-estop")
        return Program(HEEDING_CTRL_C, "ros", "driver", *options)

    def _wait_driven(self, robot: EmulatedRobot | ForeignRobot) -> None:
        """Wait until the robot has been driven for half a second."""

        def is_driven() -> bool:
            for program in (self._driver, self._commander, self._policy):
                if program is not None and program.poll() is not None:
                    raise _NotDrivenError(program.communicate()[1])
            return [turns for _, turns in robot.commands()][-50:] == [True] * 50

        wait_until(is_driven, "a robot that drives", START_TIMEOUT)

    def _measure_stop(
        self, times: Times, robot: EmulatedRobot | ForeignRobot, fault: float
    ) -> None:
        """Measure when commands and wheels became zero."""
        deadline = fault + STOP_TIMEOUT
        while (now := time.monotonic()) < deadline:
            time.sleep(0.05)
            zero, stand = find_stop(robot.commands(), fault), find_stop(robot.motion(), fault)
            if max(zero, stand) < now - QUIET_TIME:
                break
        if zero < fault:
            raise _NotDrivenError("the robot stood before the fault")
        times.zeros.append(zero - fault)
        times.stands.append(stand - fault)

    def _measure_end(self, times: Times, fault: float) -> None:
        """Measure when the program has said what is wrong, with which it must end."""
        program = self._program
        assert program is not None
        while not program.errors and time.monotonic() < fault + STOP_TIMEOUT:
            time.sleep(0.005)
        times.zeros.append(time.monotonic() - fault if program.errors else math.inf)
        code = program.wait()
        lines = program.errors.splitlines()
        if code != 3 or len(lines) != 1 or "joint_states" not in lines[0]:
            times.problems.append(f"exit status {code}, {lines}")


def count_interrupts(trials: int) -> int:
    """Press Ctrl-C in a program that drives a foreign robot, and return how often it stopped."""
    with tempfile.TemporaryDirectory(prefix="acsar-ros-stopping-") as folder:
        run = Trials(Path(folder))
        robot = ForeignRobot(Path(folder))
        command = [sys.executable, "-c", INTERRUPTED, str(run.foreign_file)]
        program = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert program.stdout is not None
        stops = 0
        try:
            for _ in range(trials):
                assert program.stdout.readline() == "drives\n", "the program has ended"
                time.sleep(random.uniform(0.0, 0.1))
                program.send_signal(signal.SIGINT)
                if not select.select([program.stdout], [], [], STOP_TIMEOUT)[0]:
                    program.send_signal(signal.SIGINT)  # the first one was lost
                else:
                    stops += 1
                program.stdout.readline()
        finally:
            program.kill()
            program.communicate()
            robot.close()
    return stops


class _NotDrivenError(Exception):
    """The robot wasn't driven when the fault was due."""


def measure(trials: int, kinds: Sequence[Kind] = KINDS) -> Iterator[Times]:
    """Run trials of each kind, each with a new program."""
    os.environ[MARK] = str(os.getpid())
    with tempfile.TemporaryDirectory(prefix="acsar-ros-stopping-") as folder, nursery(*PRELOADED):
        for kind in kinds:
            times = Trials(Path(folder)).run(kind, trials)
            if left := _wait_for_end():
                times.problems.append(f"processes that go on: {left}")
            yield times


def list_watchdogs() -> list[str]:
    """Command lines of the watchdogs that programs of this process have left behind."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            words = " ".join(process.cmdline())
            if "watchdog_child" in words and process.environ().get(MARK) == str(os.getpid()):
                found.append(words)
    return found


def _wait_for_end() -> list[str]:
    """Watchdogs that go on though their programs have ended."""
    deadline = time.monotonic() + STOP_TIMEOUT
    while (left := list_watchdogs()) and time.monotonic() < deadline:
        time.sleep(0.1)
    return left


def main() -> int:
    """Exit code 0 where every robot stopped in time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=20, help="of each kind of fault")
    parser.add_argument("--only", default="", help="kinds with this in their names")
    parser.add_argument("--interrupts", type=int, metavar="N", help="only press Ctrl-C N times")
    options = parser.parse_args()
    if options.interrupts is not None:
        stops = count_interrupts(options.interrupts)
        print(f"{stops} of {options.interrupts} Ctrl-C stopped the robot")
        return int(stops < options.interrupts)
    kinds = [kind for kind in KINDS if options.only in f"{kind.text} {kind}"]
    drawn = Table("fault", "min", "median", "max", "in time", "wheels stand: median, max [ms]",
        title="from fault to zero command [ms]")  # fmt: skip
    sound = True
    for times in measure(options.trials, kinds):
        sound = sound and times.sound
        zeros, limit = times.zeros, times.kind.limit
        in_time = sum(took <= limit for took in zeros)
        cells = [f"{1e3 * pick(zeros):.0f}" for pick in (min, statistics.median, max)]
        cells.append(f"{in_time} of {len(zeros)} within {1e3 * limit:.0f}")
        cells.append(
            ", ".join(f"{1e3 * pick(times.stands):.0f}" for pick in (statistics.median, max))
            if times.stands
            else "-"
        )
        drawn.add_row(times.kind.text, *cells)
        print(times.kind.text, *cells, *times.problems, sep="  ", file=sys.stderr, flush=True)
    Console().print(drawn)
    return int(not sound)


if __name__ == "__main__":
    sys.exit(main())
