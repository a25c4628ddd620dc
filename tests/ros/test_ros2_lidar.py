"""`--lidar ros2` reads the scans of other makers' robots, and refuses scans of an unknown pose."""

from __future__ import annotations

import numpy as np
import pytest
from ros_tools import StartRobot

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import LidarError
from acsar_gym.lidar.ros2 import RosLidar
from acsar_gym.lidar.scan import Revolution
from acsar_gym.worlds import Scene

YAW = 1.6
SCANS = ("--scan-rate", 10, "--scan-yaw", YAW)
WALLS = (-2.0, -1.5, 4.0, 2.5)
"""Least x and y, and largest x and y, of the robot's room [m]."""
CONFIG = RobotConfig(
    ros2={"joints": ["right_front", "left_front", "left_rear", "right_rear"]},
    control_rate=50.0,
    connect_timeout=3.0,
    lidar_x_offset=0.1,
    lidar_frame="laser",
)


def measure(namespace: str, config: RobotConfig) -> Revolution:
    """The first revolution of the robot's LiDAR."""
    link = open_link(f"ros2:{namespace}", config)
    lidar = RosLidar(f"ros2:{namespace}", link, config)
    link.open()
    try:
        lidar.reset(Scene(), np.random.default_rng(0))
        return lidar.scan()
    finally:
        lidar.close()
        link.close()


def shows_the_room(revolution: Revolution) -> bool:
    """Whether each measurement is of a wall, as seen by a robot at the origin."""
    x = 0.1 + revolution.distances * np.cos(revolution.bearings)
    y = revolution.distances * np.sin(revolution.bearings)
    gaps = np.abs([x - WALLS[0], y - WALLS[1], x - WALLS[2], y - WALLS[3]]).min(axis=0)
    return bool(len(gaps) == 360 and gaps.max() < 0.01)


@pytest.mark.parametrize("static", ["global", "namespaced"])
def test_scan_uses_the_transform_of_its_frame(
    static: str, start_robot: StartRobot, namespace: str
) -> None:
    start_robot(*SCANS, "--static", static, "--scan-time-increment", 0.0002)
    assert shows_the_room(measure(namespace, CONFIG.with_(lidar_yaw=0.3)))


@pytest.mark.parametrize("flags", [("--static", "none"), ("--mast",)], ids=["none", "mast"])
def test_scan_uses_the_robots_file_without_a_transform(
    flags: tuple[str, ...], start_robot: StartRobot, namespace: str
) -> None:
    start_robot(*SCANS, *flags)
    assert shows_the_room(measure(namespace, CONFIG.with_(lidar_yaw=YAW)))


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--static", "none"), "no transform from 'base_link' to its frame 'laser' .*lidar_yaw"),
        (("--mast",), r"no transform .*has mast -> laser\): write .* lidar_yaw"),
        (("--upside-down",), "its frame is tilted by 180.0 degrees"),
        (("--scan-time-increment", "0.1"), "time_increment = 0.1: 360 rays would take 35.9 s"),
        (("--scan-rays", "0"), "has no ranges"),
    ],
    ids=["no transform", "mast", "upside down", "slow rays", "no rays"],
)
def test_scan_refuses_an_unknown_pose_and_bad_rays(
    flags: tuple[str, ...], message: str, start_robot: StartRobot, namespace: str
) -> None:
    start_robot(*SCANS, *flags)
    with pytest.raises(LidarError, match=message) as caught:
        measure(namespace, CONFIG)
    assert str(caught.value).isprintable()
