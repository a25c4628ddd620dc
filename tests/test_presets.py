"""Robots that come with the package, and aren't the ACSAR: they drive on both simulated links."""

from __future__ import annotations

import math

import pytest

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.worlds import Pose
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius, shortest_path

Twist = tuple[float, float]
TURN = {"husky": 1.87, "jackal": 4.0}
"""Yaw rate of a full action [rad/s]. A Husky's wheels don't turn fast enough for its 2 rad/s."""


def drive(robot: Robot, linear: float, angular: float, ticks: int) -> tuple[Pose, Twist]:
    """Drive, and return the true pose and twist."""
    for _ in range(ticks):
        robot.drive(linear, angular)
    assert robot.link.truth is not None
    return robot.link.truth.pose, robot.link.truth.twist


@pytest.mark.parametrize("link", ["planar", "bullet"])
@pytest.mark.parametrize("name", TURN)
def test_presets_drive_and_turn_as_published(name: str, link: str) -> None:
    config = RobotConfig.preset(name)
    with Robot(open_link(link, config), config) as robot:
        _, twist = drive(robot, config.max_linear, 0.0, ticks=120)
        assert twist == pytest.approx((config.max_linear, 0.0), abs=0.01)
        start, twist = drive(robot, 0.0, 0.0, ticks=150)
        assert twist == pytest.approx((0.0, 0.0), abs=1e-3)
        assert robot.odometry.pose == pytest.approx(start, abs=0.05)
        end, twist = drive(robot, 0.0, config.max_angular, ticks=120)
        assert twist == pytest.approx((0.0, TURN[name]), abs=0.01)
        assert math.dist(start[:2], end[:2]) < 0.01


@pytest.mark.parametrize("name", TURN)
def test_presets_can_cross_worlds_made_for_them(name: str) -> None:
    """A Husky is as wide as most gaps of BARN. There it needs a difficulty below 0.25."""
    radius = footprint_radius(RobotConfig.preset(name))
    world = Pool.of("barn:0-0", 0.2, radius)[0]
    assert len(shortest_path(world, radius)) >= 2
