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
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import psutil
from geometry_msgs.msg import TwistStamped
from rich.console import Console
from rich.table import Table
from ros_tools import BEST_EFFORT, Client, Program
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


def note_arrival(times: list[int], _: Any, info: Any) -> None:
    """Note when the middleware got a message [ns]."""
    times.append(info["received_timestamp"])


def measure(seconds: float) -> list[Figure]:
    """Drive for some time, and return the figures."""
    config = RobotConfig.preset("acsar").with_(connect_timeout=TIMEOUT)
    states: list[int] = []
    commands: list[int] = []
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        file = folder / "robot.yaml"
        config.save(file)
        board = stack.enter_context(emulated_board(config, lidar=True))
        options = ("--link", board.device, "--lidar", f"rplidar://{board.lidar_device}")
        driver = Program(
            ("-m", "acsar_gym", "ros", "driver", *options, "--robot", str(file)), folder
        )
        stack.callback(driver.end, signal.SIGINT)
        program = Program(("-c", DRIVING, str(file), str(seconds + SETTLED + 1.0)), folder)
        stack.callback(program.kill)

        listener = stack.enter_context(contextlib.closing(Client("/", [driver, program])))
        for kind, topic, times in (
            (JointState, "joint_states", states),
            (TwistStamped, "cmd_vel", commands),
        ):
            note = partial(note_arrival, times)
            listener.node.create_subscription(kind, topic, note, BEST_EFFORT)
        listener.wait(lambda: len(commands) >= 10, "commands", 10.0 * TIMEOUT)
        listener.spin(SETTLED)
        states.clear()
        commands.clear()
        start_cpu = [read_cpu(process) for process in (driver, program)]
        listener.spin(seconds)
        cpu = [read_cpu(process) for process in (driver, program)]
        program.wait()
        late, ticks, p99, worst = json.loads(program.printed.splitlines()[-1])
    driver_cpu, program_cpu = (
        (end - start) / seconds for start, end in zip(start_cpu, cpu, strict=True)
    )

    # The time from each joint state to the next command [ms].
    commands.sort()
    places = ((state, bisect.bisect(commands, state)) for state in states)
    waits = [(commands[place] - state) / 1e6 for state, place in places if place < len(commands)]
    return [
        Figure("CPU of the driver", driver_cpu, limit=0.25),
        Figure("CPU of the program", program_cpu, limit=0.25),
        Figure("late ticks of the program", late / ticks, limit=0.01),
        Figure("lateness of the program, 99 %", p99 * 1e3, MILLISECONDS),
        Figure("lateness of the program, worst", worst * 1e3, MILLISECONDS),
        Figure("joint states to command, median", statistics.median(waits), MILLISECONDS, 2.0),
        Figure("joint states to command, worst", max(waits), MILLISECONDS),
        Figure("/joint_states", len(states) / seconds, "{:.1f} Hz"),
        Figure("/cmd_vel", len(commands) / seconds, "{:.1f} Hz"),
    ]


def read_cpu(program: Program) -> float:
    """Return the CPU time that a process has used [s]."""
    times = psutil.Process(program.process.pid).cpu_times()
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
