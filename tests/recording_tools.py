"""Makes small recordings."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.recording import Recorder


def drive(path: Path, config: RobotConfig, ticks: int = 120, **options: Any) -> Path:
    """Record the planar robot with its LiDAR in curves; returns the path."""
    recorder = Recorder(path, {"command": "test"}, **options)
    with Robot(open_link("planar", config), config, ["lidar"], recorder) as robot:
        for tick in range(ticks):
            robot.drive(0.3, math.sin(tick / 20.0))
    return path


def begun(path: Path) -> bytes:
    """The first two thirds of a recording's chunks, as while it is being written."""
    data = path.read_bytes()
    return data[: 2 * data.index(b"acsar_gym_end") // 3]
