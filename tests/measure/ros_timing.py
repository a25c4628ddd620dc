"""Measure how punctual a robot in ROS is, and what it costs: `make ros-timing`.

`acsar-gym ros driver` runs over an emulated board and its LiDAR, and a program drives it by
`link="ros2"`, both at 100 Hz. A node beside them gets from the middleware when each message
arrived. The machine should do nothing else.
"""

from __future__ import annotations

import argparse
import bisect
import contextlib
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import psutil
import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.executors import SingleThreadedExecutor
from rich.console import Console
from rich.table import Table
from ros_tools import BEST_EFFORT
from sensor_msgs.msg import JointState

from acsar_gym.config import RobotConfig
from acsar_gym.testing import TIMEOUT, emulated_board

SETTLED = 2.0
"""Time after the first command before anything is measured [s]."""
DRIVING = """
import json, sys, time
from acsar_gym import Robot, RobotConfig, open_link

config = RobotConfig.load(sys.argv[1])
with Robot(open_link("ros2", config), config) as robot:
    end = time.monotonic() + float(sys.argv[2])
    while time.monotonic() < end:
        robot.drive(0.1, 0.3)
    lateness = robot.timing.lateness
print(json.dumps([lateness.late_ticks, lateness.ticks, lateness.p99, lateness.worst]))
"""


class Figure(NamedTuple):
    """A measured number, and what it must be less than."""

    name: str
    value: float
    format: str = "{:.2%}"
    limit: float = float("inf")


MILLISECONDS = "{:.2f} ms"


class Arrivals:
    """A node that notes when joint states and commands arrive [ns]."""

    def __init__(self) -> None:
        rclpy.init()
        self.executor = SingleThreadedExecutor()
        node = rclpy.create_node("arrivals")
        self.executor.add_node(node)
        self.states: list[int] = []
        self.commands: list[int] = []
        for message, topic, times in (
            (JointState, "joint_states", self.states),
            (TwistStamped, "cmd_vel", self.commands),
        ):
            note = partial(note_arrival, times)
            node.create_subscription(message, topic, note, BEST_EFFORT)

    def spin(self, seconds: float) -> None:
        """Take messages for some time."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=max(end - time.monotonic(), 0.0))

    def close(self) -> None:
        """End the node."""
        self.executor.shutdown()
        rclpy.shutdown()


def note_arrival(times: list[int], _: Any, info: Any) -> None:
    """Note when a message arrived."""
    times.append(info["received_timestamp"])


def measure(seconds: float) -> list[Figure]:
    """Drive for some time, and return the figures."""
    config = RobotConfig.preset("acsar").with_(connect_timeout=TIMEOUT)
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        file = Path(folder, "robot.yaml")
        config.save(file)
        board = stack.enter_context(emulated_board(config, lidar=True))
        options = ["--link", board.device, "--lidar", f"rplidar://{board.lidar_device}"]
        options += ["--robot", str(file)]
        driver = subprocess.Popen([sys.executable, "-m", "acsar_gym", "ros", "driver", *options])
        stack.callback(driver.wait)
        stack.callback(driver.send_signal, signal.SIGINT)
        command = [sys.executable, "-c", DRIVING, str(file), str(seconds + SETTLED + 1.0)]
        program = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        stack.callback(program.kill)
        arrivals = stack.enter_context(contextlib.closing(Arrivals()))

        while len(arrivals.commands) < 10:
            assert driver.poll() is None, "the driver has ended"
            assert program.poll() is None, "the program has ended"
            arrivals.spin(0.1)
        arrivals.spin(SETTLED)
        arrivals.states.clear()
        arrivals.commands.clear()
        processes: list[Any] = [driver, program]
        cpu = [read_cpu(process) for process in processes]
        arrivals.spin(seconds)
        driver_cpu, program_cpu = (
            (read_cpu(process) - start) / seconds
            for process, start in zip(processes, cpu, strict=True)
        )
        late, ticks, p99, worst = json.loads(program.communicate(timeout=TIMEOUT)[0])

    # The time from each joint state to the next command [ms].
    commands = sorted(arrivals.commands)
    places = ((state, bisect.bisect(commands, state)) for state in arrivals.states)
    waits = [(commands[place] - state) / 1e6 for state, place in places if place < len(commands)]
    return [
        Figure("CPU of the driver", driver_cpu, limit=0.25),
        Figure("CPU of the program", program_cpu, limit=0.25),
        Figure("late ticks of the program", late / ticks, limit=0.01),
        Figure("lateness of the program, 99 %", p99 * 1e3, MILLISECONDS),
        Figure("lateness of the program, worst", worst * 1e3, MILLISECONDS),
        Figure("joint states to command, median", statistics.median(waits), MILLISECONDS, 2.0),
        Figure("joint states to command, worst", max(waits), MILLISECONDS),
        Figure("/joint_states", len(arrivals.states) / seconds, "{:.1f} Hz"),
        Figure("/cmd_vel", len(commands) / seconds, "{:.1f} Hz"),
    ]


def read_cpu(process: subprocess.Popen[Any]) -> float:
    """Return the CPU time that a process has used [s]."""
    times = psutil.Process(process.pid).cpu_times()
    return float(times.user + times.system)


def main() -> int:
    """Print a table. The exit code is 0 if all figures are below their limits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    figures = measure(parser.parse_args().seconds)

    table = Table("figure", "measured", "required")
    for name, value, form, limit in figures:
        required = f"under {form.format(limit)}" if limit < float("inf") else ""
        table.add_row(name, form.format(value), required)
    table.caption = f"load of the machine: {os.getloadavg()[0]:.1f}; {os.cpu_count()} cores"
    Console().print(table)
    return int(any(figure.value >= figure.limit for figure in figures))


if __name__ == "__main__":
    sys.exit(main())
