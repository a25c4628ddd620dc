"""Benchmark of recordings: what a tick costs the control loop's own thread."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from acsar_gym.bench.measure import Figure
from acsar_gym.config import RobotConfig
from acsar_gym.errors import MissingExtraError
from acsar_gym.links import open_link
from acsar_gym.recording import Recorder
from acsar_gym.robot import Robot

BLOCKS = 25
TICKS = 100
"""Ticks of one block."""
BREAK = 0.05
"""Between two blocks, in which the writer catches up [s]."""
LIDAR = {"rays": 360, "rate": 100.0}
"""A scan in every tick."""


def measure() -> list[Figure]:
    """Compare ticks of the planar robot with a LiDAR at 100 Hz, with and without recording.

    Time of the thread's processor, in blocks that take turns, so that other threads and programs
    don't count.
    """
    config = RobotConfig.of(None).with_(lidar=LIDAR)
    with tempfile.TemporaryDirectory() as folder:
        try:
            bare, recorded = _robot(config), _robot(config, Recorder(Path(folder) / "bench.mcap"))
            with bare, recorded:
                pairs = [(_tick(bare), _tick(recorded)) for _ in range(BLOCKS)]
        except MissingExtraError:
            return []
    without, with_it = (min(times) for times in zip(*pairs, strict=True))
    cost = max(with_it - without, 1e-9)
    return [Figure("recording, per tick, on the loop's thread", cost * 1e6, "us")]


def _robot(config: RobotConfig, recorder: Recorder | None = None) -> Robot:
    """Make a planar robot with a LiDAR."""
    return Robot(open_link("planar", config), config, ["lidar"], recorder)


def _tick(robot: Robot) -> float:
    """Return the thread's time for a tick [s]."""
    begin = time.thread_time()
    for _ in range(TICKS):
        robot.drive(0.3, 0.2)
    took = (time.thread_time() - begin) / TICKS
    time.sleep(BREAK)
    return took
