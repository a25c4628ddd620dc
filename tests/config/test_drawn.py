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
    """On every machine, so that the hash is always this one."""
    assert RobotConfig.of("drawn:17") == FIRST[17]
    text = json.dumps([drawn.draw_robot(number) for number in range(20)])
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == "ef8d842fb126c273"
    assert len({hash_config(one) for one in FIRST}) == len(FIRST)


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
    radii = {outline_radius(one.outline) for one in FIRST}
    assert radii == set(drawn.RADII)


def test_wheels_and_motors_suit_the_body() -> None:
    for one in FIRST:
        rim = one.motor.max_speed * one.wheel_radius
        turning = one.max_angular * one.effective_separation / 2.0
        assert rim >= 1.05 * max(one.max_linear, turning)
        assert 2.0 * one.wheel_radius < one.wheelbase + 0.2 * one.body.length
        assert math.hypot(one.wheelbase, one.wheel_separation) / 2.0 < outline_radius(one.outline)
        place = one.lidar_x_offset, one.lidar_y_offset
        assert math.hypot(*place) < outline_radius(one.outline)
        assert border_distance(one.outline, 0.0, 0.0) > 0.05
