"""Robots that come with the package, and aren't the ACSAR: they drive on both simulated links."""

from __future__ import annotations

import math

import pytest

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import footprint_radius, shortest_path

PRESETS = ("husky", "jackal")
LINKS = ("planar", "bullet")
TURN = {"husky": 1.87, "jackal": 4.0}
"""Yaw rate of a full action [rad/s]. A Husky's wheels don't turn fast enough for its 2 rad/s."""


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("name", PRESETS)
def test_presets_drive_as_fast_as_published_and_stop_where_odometry_says(
    name: str, link: str
) -> None:
    config = RobotConfig.preset(name)
    with Robot(open_link(link, config), config) as robot:
        for _ in range(120):
            robot.drive(config.max_linear, 0.0)
        truth = robot.link.truth
        assert truth is not None
        assert truth.twist == pytest.approx((config.max_linear, 0.0), abs=0.01)

        for _ in range(150):
            robot.drive(0.0, 0.0)
        truth = robot.link.truth
        assert truth is not None
        assert truth.twist == pytest.approx((0.0, 0.0), abs=1e-3)
        assert robot.odometry.pose == pytest.approx(truth.pose, abs=0.05)


@pytest.mark.parametrize("link", LINKS)
@pytest.mark.parametrize("name", PRESETS)
def test_presets_turn_on_the_spot_as_their_multiplier_says(name: str, link: str) -> None:
    config = RobotConfig.preset(name)
    with Robot(open_link(link, config), config) as robot:
        for _ in range(120):
            robot.drive(0.0, config.max_angular)
        truth = robot.link.truth
        assert truth is not None
        assert truth.twist == pytest.approx((0.0, TURN[name]), abs=0.01)
        assert math.hypot(*truth.pose[:2]) < 0.01


@pytest.mark.parametrize("kind", ["clutter", "rooms", "barn"])
@pytest.mark.parametrize("name", PRESETS)
def test_presets_can_cross_worlds_made_for_them(name: str, kind: str) -> None:
    """A Husky is as wide as most gaps of BARN. There it needs a difficulty below 0.25."""
    difficulty = 0.2 if (name, kind) == ("husky", "barn") else None
    radius = footprint_radius(RobotConfig.preset(name))
    world = Pool.of(f"{kind}:0-0", difficulty, radius)[0]
    assert len(shortest_path(world, radius)) >= 2
