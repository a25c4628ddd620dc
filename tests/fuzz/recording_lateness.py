"""Lateness of the control loop with and without recording, side by side on a pseudo-terminal.

A LiDAR with 360 rays gives a scan in every tick. Blocks take turns, so that other programs disturb
both alike. Prints both, and the ratio of the 99th percentiles.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.recording import Recorder, read
from acsar_gym.sensors.lidar import LidarSensor, Scan

CONFIG = RobotConfig.of(None).with_(
    lidar={"rays": 360, "rate": 100.0}, watchdog_timeout=1.0, feedback_timeout=2.0
)


class Turning:
    """A LiDAR that has a new scan whenever it is asked."""

    def __init__(self) -> None:
        self.count = 0

    def reset(self, scene: Any, rng: Any) -> None:
        """Nothing to begin."""

    def scan(self) -> Scan:
        """The next scan."""
        self.count += 1
        return Scan(np.full(360, 2.0 + 0.001 * (self.count % 100)), float(self.count))

    def close(self) -> None:
        """Nothing to close."""


def drive(device: str, seconds: float, tape: Path | None) -> list[float]:
    """Lateness of each tick [s]."""
    recorder = None if tape is None else Recorder(tape)
    sensors = [LidarSensor(Turning(), CONFIG)]
    late = []
    with Robot(open_link(device, CONFIG), CONFIG, sensors, recorder) as robot:
        for tick in range(round(seconds * 100)):
            robot.drive(0.2, 0.5 * (tick % 100 < 50))
            late.append(robot.link.lateness or 0.0)
    return late


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--blocks", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=10.0)
    asked = parser.parse_args()
    command = [sys.executable, "-m", "acsar_gym", "emulate"]
    late: dict[bool, list[float]] = {False: [], True: []}
    dropped = 0
    with (
        tempfile.TemporaryDirectory() as folder,
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as board,
    ):
        try:
            assert board.stdout is not None
            device, tape = board.stdout.readline().split()[-1], Path(folder) / "tape.mcap"
            for block in range(2 * asked.blocks):
                records = (block + block // 2) % 2 == 1
                late[records] += drive(device, asked.seconds, tape if records else None)
                dropped += read(tape).dropped if records else 0
        finally:
            board.terminate()
    for records, name in ((False, "without"), (True, "with")):
        p50, p99 = np.percentile(late[records], (50, 99)) * 1e3
        worst = max(late[records]) * 1e3
        print(f"{name:>8} recording: p50 {p50:.3f} ms, p99 {p99:.3f} ms, worst {worst:.2f} ms")
    ratio = np.percentile(late[True], 99) / np.percentile(late[False], 99)
    print(f"p99 with against without: {ratio:.3f}; {dropped} dropped")


if __name__ == "__main__":
    main()
