"""How punctual a robot in ROS is, and what it costs: `make ros-timing`.

`acsar-gym ros driver` runs over an emulated board and its LiDAR, and a program drives it by
`link="ros2"`, both at 100 Hz, each in a process of its own. A node beside them is told by the
middleware when each message arrived. The machine should do nothing else.
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
from pathlib import Path
from typing import Any

import psutil
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rich.console import Console
from rich.table import Table
from ros_tools import BEST_EFFORT
from sensor_msgs.msg import JointState

from acsar_gym.config import RobotConfig
from acsar_gym.testing import TIMEOUT, emulated_board

LATE_SHARE, CPU_SHARE, REACTION = 0.01, 0.25, 0.002
"""What must be reached: parts of all ticks, of a core, and median time [s]."""
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


def measure(seconds: float) -> dict[str, Any]:
    """Drive for so long; returns the figures by name."""
    config = RobotConfig.preset("acsar").with_(connect_timeout=TIMEOUT)
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        file = Path(folder, "robot.yaml")
        config.save(file)
        board = stack.enter_context(emulated_board(config, lidar=True))
        links = ("--link", board.device, "--lidar", f"rplidar://{board.lidar_device}")
        command = (sys.executable, "-m", "acsar_gym", "ros", "driver", "--robot", str(file))
        driver = subprocess.Popen([*command, *links, "--without-estop"])
        stack.callback(driver.wait)
        stack.callback(driver.send_signal, signal.SIGINT)
        program = subprocess.Popen(
            [sys.executable, "-c", DRIVING, str(file), str(seconds + SETTLED + 1.0)],
            stdout=subprocess.PIPE,
            text=True,
        )
        stack.callback(program.kill)
        arrivals = Arrivals()
        stack.callback(arrivals.close)
        arrivals.wait_for_commands(driver, program)
        arrivals.spin(SETTLED)
        processes = {"driver": psutil.Process(driver.pid), "program": psutil.Process(program.pid)}
        arrivals.clear()
        before = {name: read_cpu(process) for name, process in processes.items()}
        begun = time.monotonic()
        arrivals.spin(seconds)
        took = time.monotonic() - begun
        figures: dict[str, Any] = {
            f"CPU of the {name}": (read_cpu(process) - before[name]) / took
            for name, process in processes.items()
        }
        late, ticks, p99, worst = json.loads(program.communicate(timeout=TIMEOUT)[0])
    figures |= arrivals.summarize(took)
    figures |= {
        "late ticks of the program": late / ticks,
        "lateness of the program, 99 %": p99,
        "lateness of the program, worst": worst,
    }
    return figures


def read_cpu(process: psutil.Process) -> float:
    """CPU time that a process has used [s]."""
    times = process.cpu_times()
    return float(times.user + times.system)


class Arrivals:
    """A node that is told when joint states and commands arrive."""

    def __init__(self) -> None:
        rclpy.init()
        self.node = rclpy.create_node("arrivals")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.states: list[int] = []
        self.commands: list[int] = []
        self.ticks: list[tuple[int, int]] = []
        subscribe = self.node.create_subscription
        subscribe(JointState, "joint_states", self.on_state, BEST_EFFORT)
        subscribe(TwistStamped, "cmd_vel", self.on_command, BEST_EFFORT)
        subscribe(DiagnosticArray, "/diagnostics", self.on_diagnostics, QoSProfile(depth=10))

    def on_state(self, _: JointState, info: Any) -> None:
        self.states.append(info["received_timestamp"])

    def on_command(self, _: TwistStamped, info: Any) -> None:
        self.commands.append(info["received_timestamp"])

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        values = {value.key: value.value for value in message.status[0].values}
        late, ticks = values["late ticks"].split(" of ")
        self.ticks.append((int(late), int(ticks)))

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self.executor.spin_once(timeout_sec=left)

    def wait_for_commands(self, *processes: subprocess.Popen[Any]) -> None:
        while len(self.commands) < 10:
            assert all(process.poll() is None for process in processes), "nobody drives"
            self.spin(0.1)

    def clear(self) -> None:
        self.states.clear()
        self.commands.clear()
        self.ticks.clear()

    def summarize(self, seconds: float) -> dict[str, Any]:
        """Figures of what has arrived."""
        commands = sorted(self.commands)
        waits = []
        for state in self.states:
            place = bisect.bisect(commands, state)
            if place < len(commands):
                waits.append((commands[place] - state) * 1e-9)
        waits.sort()
        (late0, ticks0), (late, ticks) = self.ticks[0], self.ticks[-1]
        return {
            "late ticks of the driver": (late - late0) / (ticks - ticks0),
            "/joint_states to /cmd_vel, median": statistics.median(waits),
            "/joint_states to /cmd_vel, 95 %": waits[round(0.95 * len(waits)) - 1],
            "/joint_states": len(self.states) / seconds,
            "/cmd_vel": len(commands) / seconds,
        }

    def close(self) -> None:
        self.executor.shutdown()
        rclpy.shutdown()


def main() -> int:
    """Exit code 0 where everything is reached."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    figures = measure(parser.parse_args().seconds)
    required = {
        "late ticks of the driver": LATE_SHARE,
        "late ticks of the program": LATE_SHARE,
        "CPU of the driver": CPU_SHARE,
        "CPU of the program": CPU_SHARE,
        "/joint_states to /cmd_vel, median": REACTION,
    }
    drawn = Table("figure", "measured", "required")
    for name, value in figures.items():
        is_share = "late ticks" in name or "CPU" in name
        is_rate = name in ("/joint_states", "/cmd_vel")
        show = "{:.1f} Hz" if is_rate else "{:.2%}" if is_share else "{:.2f} ms"
        scale = 1.0 if is_rate or is_share else 1e3
        limit = show.format(required[name] * scale) if name in required else ""
        drawn.add_row(name, show.format(value * scale), limit and f"under {limit}")
    load = ", ".join(f"{number:.1f}" for number in os.getloadavg())
    drawn.caption = f"load of the machine: {load}; {os.cpu_count()} cores"
    Console().print(drawn)
    return int(any(figures[name] >= limit for name, limit in required.items()))


if __name__ == "__main__":
    sys.exit(main())
