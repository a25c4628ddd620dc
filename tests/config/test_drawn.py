"""Robots drawn at random: the same everywhere, and such as can be built."""

from __future__ import annotations

import hashlib
import json
import math

import pytest

from acsar_gym import RobotConfig
from acsar_gym.config import drawn
from acsar_gym.config.footprint import border_distance, outline_radius
from acsar_gym.config.robot import hash_config
from acsar_gym.errors import ConfigError

FIRST = [RobotConfig.of(f"drawn:{number}") for number in range(128)]


def test_a_number_is_always_the_same_robot() -> None:
    """On every machine, so that the hash is always this robot."""
    assert RobotConfig.of("drawn:17") == FIRST[17]
    text = json.dumps([drawn.draw_robot(number) for number in range(20)])
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == "ef8d842fb126c273"
    assert len({hash_config(robot) for robot in FIRST}) == len(FIRST)


@pytest.mark.parametrize("text", ["drawn:", "drawn:x", "drawn:-1", "drawn:1-", "drawn:5-3"])
def test_malformed_names_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"^robot = 'drawn:.*: (must be like|holds no robot)"):
        RobotConfig.of(text)


@pytest.mark.parametrize("fleet", ["drawn:0-3", "drawn:train"])
def test_where_one_robot_is_meant_a_fleet_is_refused(fleet: str) -> None:
    with pytest.raises(ConfigError, match="give one robot here, such as 'drawn:0'"):
        RobotConfig.of(fleet)


def test_radii_are_exactly_those_of_the_classes() -> None:
    """Robots of a class share worlds, which are made for a radius."""
    radii = {outline_radius(robot.outline) for robot in FIRST}
    assert radii == set(drawn.RADII)


def test_wheels_and_motors_suit_the_body() -> None:
    for robot in FIRST:
        rim = robot.motor.max_speed * robot.wheel_radius
        turning = robot.max_angular * robot.effective_separation / 2.0
        assert rim >= 1.05 * max(robot.max_linear, turning)
        assert 2.0 * robot.wheel_radius < robot.wheelbase + 0.2 * robot.body.length
        assert math.hypot(robot.wheelbase, robot.wheel_separation) / 2.0 < outline_radius(
            robot.outline
        )
        place = robot.lidar_x_offset, robot.lidar_y_offset
        assert math.hypot(*place) < outline_radius(robot.outline)
        assert border_distance(robot.outline, 0.0, 0.0) > 0.05
