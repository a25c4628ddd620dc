"""Measure how soon a robot in ROS stands after a fault of a process: `make ros-stopping`.

Each trial has its own processes, in a ROS domain of their own, forked from a process that has
imported everything. The measured time is from the fault to the first zero command after which no
command turns wheels, as it arrives at the robot. All processes use the same monotonic clock.

The robot is an emulated board behind `acsar-gym ros driver`, or foreign_robot.py, whose own
time-out of commands is far too long to help. If the robot's node is killed, the time is that until
the driving program reports it in one line and ends.
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
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import psutil
from processes import PRELOADED, Program, first_line, program
from ros_tools import FOREIGN_ROBOT
from serial_tools import HEEDING_CTRL_C, start
from stopping import FAULT_JITTER, LIMIT, MAX_STARTS, Stops, find_stop, list_commands, report

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LinkError
from acsar_gym.testing import wait_until

PRELOADED += ["acsar_gym.tools.ros.driver", "rclpy"]
SIGNALS = {
    "term": signal.SIGTERM,
    "kill": signal.SIGKILL,
    "int": signal.SIGINT,
    "stop": signal.SIGSTOP,
}
OWN_FAULTS = ("exception", "hang")
"""Faults that the driving program causes itself. It hangs for 5 s."""
FEEDBACK_TIMEOUT = 0.5
SLOWER = {"commander": 0.5, "robot": FEEDBACK_TIMEOUT}
"""Time-outs that come first: the driver's of /cmd_vel, and the program's of feedback [s]."""
START_TIMEOUT = 60.0
"""Longest wait for processes that start [s]."""
MARK = "ACSAR_ROS_STOPPING"
"""Environment variable by which the programs of this process are found."""
QUIET_TIME = 0.7
"""Time after a zero command without other commands [s]."""
STOP_TIMEOUT = 3.0
"""Longest wait for a zero command [s]."""
WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
DOMAINS = itertools.cycle(range(101 - 52 * WORKER, 0, -1))
"""ROS domains that no test uses at the same time: killed nodes are listed there for a while."""
IN_DOMAIN = "import os; os.environ['ROS_DOMAIN_ID'] = '{}'\n"
FOREIGN = f"import runpy; runpy.run_path({str(FOREIGN_ROBOT)!r}, run_name='__main__')"
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
"""Drives until a fault, which it may cause itself, and prints the time once it drives."""
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
POLICY = ("ros", "policy", "--goal", "6.0", "1.0", "--goal-distance", "0.5", "9.0")

Commands = Callable[[], Iterator[tuple[float, bool]]]
"""Lists when each command came [s], and whether it turns wheels."""


class Kind(NamedTuple):
    """A kind of trial."""

    victim: str
    """Process with the fault: "driver", "commander", "program", "policy" or "robot"."""
    fault: str
    robot: str = "board"
    """"board" behind the driver, or "foreign"."""

    @property
    def limit(self) -> float:
        """Longest time allowed [s]."""
        return LIMIT + SLOWER.get(self.victim, 0.0)


KINDS = (
    *(Kind("driver", fault) for fault in SIGNALS),
    Kind("commander", "kill"),
    *(Kind("program", fault, "foreign") for fault in (*SIGNALS, *OWN_FAULTS)),
    *(Kind("program", fault, "board") for fault in ("kill", "int")),
    *(Kind("policy", fault, "foreign") for fault in ("kill", "int")),
    Kind("robot", "kill", "foreign"),
)


class Processes(contextlib.ExitStack):
    """The processes of a trial. They end with the block."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder
        self._domain = next(DOMAINS)

    def run(self, code: str, *arguments: str) -> Program:
        """Run a program in the trial's ROS domain."""
        return self.enter_context(program(IN_DOMAIN.format(self._domain) + code, *arguments))

    def run_robot(self, kind: str) -> tuple[Program, Path, Commands]:
        """Run a robot's node. Returns it, the robot's file and the commands that arrive."""
        joints = {"joints": ["right_front", "left_front", "left_rear", "right_rear"]}
        config = RobotConfig.preset("acsar").with_(
            connect_timeout=20.0, feedback_timeout=FEEDBACK_TIMEOUT
        )
        file = self._folder / f"{kind}.yaml"
        log = self._folder / f"{kind}{time.monotonic_ns()}.jsonl"
        if kind == "board":
            config.save(file)
            board = self.enter_context(contextlib.closing(start(log, "--robot", str(file))))
            options = ("--link", board.device, "--robot", str(file))
            node = self.run(HEEDING_CTRL_C, "ros", "driver", *options)
            return node, file, partial(list_commands, board)

        config.with_(control_rate=50.0, ros2=joints).save(file)
        node = self.run(FOREIGN, str(log), '{"cmd_vel_timeout": 1000}')
        wait_until(log.exists, "a robot", START_TIMEOUT)
        return node, file, partial(read_commands, log)


def read_commands(log: Path) -> Iterator[tuple[float, bool]]:
    """Read the commands in the log of foreign_robot.py."""
    for line in log.read_bytes().splitlines(keepends=True):
        if line.endswith(b"\n") and b'"command"' in line:
            event = json.loads(line)
            yield event["monotonic"], any(event["command"])


def run_trial(kind: Kind, folder: Path) -> float:
    """Cause a fault in one of several new processes, and return when the robot stopped [s].

    Raises:
        LinkError: A process ended before the fault, or the robot was at rest.
    """
    with Processes(folder) as processes:
        node, file, commands = processes.run_robot(kind.robot)
        own_fault = kind.fault if kind.fault in OWN_FAULTS else ""
        if kind.victim in ("driver", "commander"):
            commander = processes.run(COMMANDER)
        elif kind.victim == "policy":
            options = ("--robot", str(file), "--yes")
            commander = processes.run(HEEDING_CTRL_C, *POLICY, *options)
        else:
            commander = processes.run(DRIVING, str(file), own_fault, str(random.randrange(40, 60)))

        if own_fault:
            start_time = first_line(commander)
            if not start_time:
                raise LinkError(commander.communicate()[1])
            fault = float(start_time)
        else:
            wait_for_driving(commands, node, commander)
            time.sleep(random.uniform(0.0, FAULT_JITTER))
            victim = node if kind.victim in ("driver", "robot") else commander
            fault = time.monotonic()
            victim.send_signal(SIGNALS[kind.fault])
        if kind.victim == "robot":
            return measure_end(commander, fault)

        zero = math.inf
        while not zero < time.monotonic() - QUIET_TIME and time.monotonic() < fault + STOP_TIMEOUT:
            time.sleep(0.05)
            zero = find_stop(commands(), fault)
        if zero < fault:
            raise LinkError("the robot was at rest before the fault")
        return zero - fault


def wait_for_driving(commands: Commands, *programs: Program) -> None:
    """Wait until the robot has been driven for half a second."""

    def is_driven() -> bool:
        for process in programs:
            if process.poll() is not None:
                raise LinkError(process.communicate()[1])
        return [turns for _, turns in commands()][-50:] == [True] * 50

    wait_until(is_driven, "a robot that drives", START_TIMEOUT)


def measure_end(driving: Program, fault: float) -> float:
    """Return when a program reported the lost node [s]. inf if not in one line with its status."""
    while not driving.errors and time.monotonic() < fault + STOP_TIMEOUT:
        time.sleep(0.005)
    reported = time.monotonic() - fault
    code = driving.wait()
    lines = driving.errors.splitlines()
    return reported if code == 3 and len(lines) == 1 and "joint_states" in lines[0] else math.inf


def measure(trials: int, kinds: Sequence[Kind] = KINDS) -> Iterator[Stops]:
    """Run trials of each kind.

    Raises:
        LinkError: Watchdogs of a kind go on after it.
    """
    os.environ[MARK] = str(os.getpid())
    with tempfile.TemporaryDirectory(prefix="acsar-ros-stopping-") as folder:
        for kind in kinds:
            times = [repeat_trial(kind, Path(folder)) for _ in range(trials)]
            wait_until(lambda: not list_watchdogs(), "watchdogs that end", STOP_TIMEOUT)
            yield Stops(", ".join(kind), times, kind.limit)


def repeat_trial(kind: Kind, folder: Path) -> float:
    """Run a trial, again if a busy computer didn't drive the robot. Return inf if it never did."""
    for _ in range(MAX_STARTS):
        try:
            return run_trial(kind, folder)
        except LinkError as error:
            print(*kind, f"not driven: {error}", file=sys.stderr)
    return math.inf


def list_watchdogs() -> list[str]:
    """Command lines of the watchdogs that programs of this process have left behind."""
    watchdogs = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            command = " ".join(process.cmdline())
            if "watchdog_child" in command and process.environ().get(MARK) == str(os.getpid()):
                watchdogs.append(command)
    return watchdogs


def count_interrupts(trials: int) -> int:
    """Press Ctrl-C in a program that drives a foreign robot, and return how often it stopped."""
    stops = 0
    with (
        tempfile.TemporaryDirectory(prefix="acsar-ros-stopping-") as folder,
        Processes(Path(folder)) as processes,
    ):
        _, file, _ = processes.run_robot("foreign")
        driving = processes.run(INTERRUPTED, str(file))

        for _ in range(trials):
            assert first_line(driving) == "drives", driving.errors
            time.sleep(random.uniform(0.0, 0.1))
            driving.send_signal(signal.SIGINT)
            if select.select([driving.stdout], [], [], STOP_TIMEOUT)[0]:
                stops += 1
            else:
                driving.send_signal(signal.SIGINT)  # the first signal was lost
            first_line(driving)
    return stops


def main() -> int:
    """Measure, and report the times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=20, help="of each kind of fault")
    parser.add_argument("--only", default="", help="kinds with this in their names")
    options = parser.parse_args()
    return report(measure(options.trials, [k for k in KINDS if options.only in " ".join(k)]))


if __name__ == "__main__":
    sys.exit(main())
