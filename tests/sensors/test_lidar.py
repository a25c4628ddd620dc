"""The sensor of a LiDAR: its revolutions, and those of a user's own LiDAR."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from acsar_gym import Robot, RobotConfig
from acsar_gym.errors import LidarError
from acsar_gym.lidar.scan import Revolution, Scan
from acsar_gym.links import open_link
from acsar_gym.physics import compute_physics
from acsar_gym.recording import Recorder
from acsar_gym.recording.replay import ReplayLink
from acsar_gym.sensors.lidar import LidarSensor
from acsar_gym.worlds import Scene, World

ACSAR = RobotConfig.preset("acsar")
PILLAR = World(np.array([[0.85, 2.0, 0.5]]))


def test_scan_sees_a_pillar_to_the_left_from_the_lidars_own_place() -> None:
    """The LiDAR sits 15 cm behind the robot's centre, so the pillar is exactly at its side."""
    config = ACSAR.with_(lidar={"noise": 0.0, "rays": 4})
    with Robot(open_link("planar", config), config, ["lidar"]) as robot:
        robot.reset(Scene(start=(1.0, 0.0, 0.0), world=PILLAR))
        assert robot.sensors[0].scan.ranges == pytest.approx([5.0, 5.0, 5.0, 1.5], abs=1e-6)
        assert robot.read() == pytest.approx([1.0, 1.0, 1.0, 0.3])


def test_revolution_is_the_newest_complete_one() -> None:
    rate = 5.5
    config = ACSAR.with_(lidar={"noise": 0.0, "rate": rate})
    scans: list[tuple[float, Revolution, Scan]] = []
    with Robot(open_link("planar", config), config, ["lidar"]) as robot:
        robot.reset(Scene(start=(1.0, 0.0, 0.0), world=PILLAR), np.random.default_rng(2))
        for _ in range(25):
            for _ in range(7):
                robot.drive(0.3, 0.8)
            sensor = robot.sensors[0]
            scans.append((robot.link.now(), sensor.revolution, sensor.scan))
    ages = [now - scan.stamp for now, _, scan in scans]
    assert 0.0 <= min(ages) < 0.6 / rate < max(ages) <= 1.0 / rate

    for step, (_, revolution, scan) in enumerate(scans):
        since = revolution.times - (scan.stamp - 1.0 / rate)
        assert -1e-9 < since.min() < since.max() < 1.0 / rate + 1e-9
        # The head turns clockwise, evenly, from straight ahead. A robot's ramps bend that, and one
        # that turns against the head leaves a gap between the ends, in which the end counts.
        expected = -2.0 * math.pi * rate * since
        off = np.remainder(revolution.bearings - expected + math.pi, 2.0 * math.pi) - math.pi
        assert np.sort(np.abs(off))[-3] < (0.1 if step < 10 else 0.01)
        assert np.ptp(since) > 0.9 / rate


def test_scan_of_a_slow_lidar_sees_the_wall_where_it_is(tmp_path: Path) -> None:
    """Its oldest measurements are two turns old. A replay sees the same, to the bit."""
    config = ACSAR.with_(lidar={"noise": 0.0})
    physics = compute_physics(config)._replace(scan_rate=0.5)
    wall = World(np.zeros((0, 3)), np.array([[4.0, -30.0, 4.0, 30.0]]))
    tape = tmp_path / "tape.mcap"
    readings = []

    with Robot(open_link("planar", config), config, ["lidar"], Recorder(tape)) as robot:
        robot.reset(Scene(world=wall, physics=physics), np.random.default_rng(1))
        for _ in range(400):
            robot.drive(0.3, 0.0)
            x = robot.link.truth.pose[0] + config.lidar_x_offset  # type: ignore[union-attr]
            readings.append(robot.read())
            assert readings[-1][32] * 5.0 == pytest.approx(min(4.0 - x, 5.0), abs=0.02)
    with Robot(ReplayLink(tape, compare=False), config, ["lidar"]) as robot:
        robot.reset(Scene(), np.random.default_rng(1))
        for reading in readings:
            robot.drive(0.3, 0.0)
            assert robot.read().tobytes() == reading.tobytes()


GOOD: dict[str, Any] = {
    "bearings": [0.1, -0.1, 6.2],
    "distances": [1.0, 0.0, 1e6],
    "times": [0.0, -4e9, 0.1],
    "stamp": 0.1,
}


@pytest.mark.parametrize(
    ("changed", "now", "message"),
    [
        ({}, 1.0, None),
        ({}, 1.2, r"no complete turn for 1\.10 s \(lidar\.timeout = 1 s\)"),
        ({"stamp": 30.0}, 0.2, None),  # a recorded link's clock stands still at a reset
        ({"stamp": 1.7e9}, 0.2, r"measured 1\.7e\+09 s after now .*Link.clock"),
        ({"bearings": [0.0, 90.0, 3.0]}, 0.2, "bearings = .*: must be from -6.283 to 6.283 rad"),
        ({"stamp": math.nan}, 0.2, "stamp = nan: must be from"),
        ({"times": [0.0, 0.1]}, 0.2, "gave Revolution"),
        ({name: [[0.0]] for name in ("bearings", "distances", "times")}, 0.2, "gave Revolution"),
        (None, 0.2, "gave None"),
    ],
)
def test_revolution_of_a_users_lidar_is_checked(
    changed: dict[str, Any] | None, now: float, message: str | None
) -> None:
    made = None if changed is None else Revolution(**{**GOOD, **changed})
    lidar: Any = SimpleNamespace(scan=lambda: made)
    sensor = LidarSensor(lidar, ACSAR)
    if message is None:
        sensor.poll(None, now)
        assert len(sensor.scan.ranges) == ACSAR.lidar.rays
        return
    with pytest.raises(LidarError, match=f"SimpleNamespace.*{message}") as caught:
        sensor.poll(None, now)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400
