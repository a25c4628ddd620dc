"""`--lidar ros2` reads the scans of other makers' robots, and refuses scans of an unknown pose."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from ros_tools import StartRobot

from acsar_gym import RobotConfig, open_link
from acsar_gym.errors import LidarError
from acsar_gym.lidar.ros2 import RosLidar
from acsar_gym.lidar.scan import Revolution
from acsar_gym.worlds import Scene

YAW = 1.6
WALLS = (-2.0, -1.5, 4.0, 2.5)
"""Least x and y, and largest x and y, of the robot's room [m]."""


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


@pytest.fixture
def config(foreign_config: RobotConfig) -> RobotConfig:
    return foreign_config.with_(connect_timeout=3.0, lidar_x_offset=0.1, lidar_frame="laser")


@pytest.mark.parametrize(
    ("options", "yaw"),
    [({}, 0.3), ({"static": "tf_static"}, 0.3), ({"mast": True}, YAW)],
    ids=["transform", "namespaced", "mast"],
)
def test_scan_uses_the_transform_of_its_frame_or_the_robots_file(
    options: dict[str, Any],
    yaw: float,
    config: RobotConfig,
    start_robot: StartRobot,
    namespace: str,
) -> None:
    start_robot(scan_yaw=YAW, **options)
    assert shows_the_room(measure(namespace, config.with_(lidar_yaw=yaw)))


def test_scan_refuses_an_unknown_pose(
    config: RobotConfig, start_robot: StartRobot, namespace: str
) -> None:
    start_robot(scan_yaw=YAW, mast=True)
    message = r"no transform from 'base_link' to its frame 'laser' .*mast -> laser\): .* lidar_yaw"
    with pytest.raises(LidarError, match=message) as caught:
        measure(namespace, config)
    assert str(caught.value).isprintable()
