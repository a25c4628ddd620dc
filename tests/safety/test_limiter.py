"""Limits of speed, acceleration and jerk: ROS's rules, and properties that follow from them."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsar_gym.config import RobotConfig, SpeedLimits
from acsar_gym.errors import ConfigError
from acsar_gym.safety.rules import (
    AxisLimits,
    is_unlimited,
    limit_velocity,
    read_both_limits,
    read_limits,
)

DT = 0.01
speed = st.floats(-3.0, 3.0)


def driven(wanted: list[float], **kind: float) -> list[float]:
    """What is sent, tick by tick, from standstill."""
    numbers, sent = read_limits(SpeedLimits(**kind)), [0.0, 0.0]
    for velocity in wanted:
        sent.append(limit_velocity(velocity, sent[-1], sent[-2], DT, numbers))
    return sent[2:]


def test_nothing_is_limited_by_default() -> None:
    assert read_limits(SpeedLimits()).free
    assert driven([9.0, -9.0, 0.0]) == pytest.approx([9.0, -9.0, 0.0])


def test_acceleration_is_a_ramp() -> None:
    sent = driven([1.0] * 60, max_acceleration=2.0)
    assert sent[:3] == pytest.approx([0.02, 0.04, 0.06])
    assert sent[49:] == pytest.approx([1.0] * 11)


def test_braking_has_a_limit_of_its_own() -> None:
    sent = driven([1.0] * 60 + [0.0] * 60, max_acceleration=2.0, min_acceleration=-5.0)
    assert sent[60:63] == pytest.approx([0.95, 0.9, 0.85])


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_jazzys_names_tell_speeding_up_and_braking_apart(sign: float) -> None:
    """Forward at 2, braking at 5; backward at 1, braking at 4, as the signs in ROS are or not."""
    there, back = [1.0] * 60 + [0.0] * 30, [-1.0] * 120 + [0.0] * 40
    sent = driven(
        there + back,
        max_acceleration=2.0,
        max_deceleration=-5.0 * sign,
        max_acceleration_reverse=-1.0 * sign,
        max_deceleration_reverse=4.0 * sign,
    )
    assert sent[:2] == pytest.approx([0.02, 0.04])
    assert sent[60:62] == pytest.approx([0.95, 0.9])
    assert sent[90:92] == pytest.approx([-0.01, -0.02])
    assert sent[210:212] == pytest.approx([-0.96, -0.92])


def test_what_jazzy_leaves_out_follows_from_the_rest() -> None:
    sent = driven([-1.0] * 60 + [0.0] * 30, max_acceleration=2.0, max_deceleration=-5.0)
    assert sent[:2] == pytest.approx([-0.02, -0.04])
    assert sent[60:62] == pytest.approx([-0.95, -0.9])


def test_an_axis_takes_ready_limits_without_a_default() -> None:
    config = RobotConfig(linear_limits=SpeedLimits(max_velocity=0.3))
    assert config.linear_limits.max_acceleration is None
    assert RobotConfig(**config.model_dump()) == config


def test_velocity_limits_may_differ_by_direction() -> None:
    assert driven([2.0, -2.0], max_velocity=0.5, min_velocity=-0.1) == pytest.approx([0.5, -0.1])
    assert driven([2.0, -2.0], max_velocity=0.5) == pytest.approx([0.5, -0.5])


def test_jerk_is_the_second_difference_over_two_periods_squared() -> None:
    """As the ROS controller has it: the ramp's slope grows by 2 * jerk * dt^2 a tick."""
    sent = driven([1.0] * 5, max_jerk=100.0)
    assert sent == pytest.approx([0.02, 0.06, 0.12, 0.2, 0.3])


@given(st.lists(speed, min_size=3, max_size=60))
def test_what_is_sent_keeps_to_the_limits(wanted: list[float]) -> None:
    sent = [0.0, *driven(wanted, max_velocity=0.8, max_acceleration=3.0)]
    assert all(abs(velocity) <= 0.8 + 1e-12 for velocity in sent)
    assert all(abs(b - a) <= 3.0 * DT + 1e-12 for a, b in pairwise(sent))


@given(st.lists(speed, min_size=3, max_size=60))
def test_without_reaching_other_limits_jerk_is_bounded(wanted: list[float]) -> None:
    sent = [0.0, 0.0, *driven(wanted, max_jerk=50.0)]
    slopes = [b - a for a, b in pairwise(sent)]
    assert all(abs(b - a) <= 2.0 * 50.0 * DT**2 + 1e-12 for a, b in pairwise(slopes))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"linear_limits": {"max_velocity": -1.0}}, "^linear_limits.max_velocity"),
        ({"linear_limits": {"max_decelaration": 1.0}}, "'linear_limits.max_decelaration'; did you"),
        ({"angular_limits": {"max_deceleration": 0.0}}, "^angular_limits.max_deceleration"),
        (
            {"linear_limits": {"max_deceleration": -2.0, "min_acceleration": -2.0}},
            "linear_limits.min_acceleration .of ROS 2 Humble. and linear_limits.max_deceleration",
        ),
        ({"linear_limits": {"max_accel": 1.0}}, "did you mean 'max_acceleration'"),
        ({"angular_limits": {"min_jerk": 3.0}}, "^angular_limits.min_jerk"),
        ({"geofence": {"min_x": 1.0}}, "start"),
        ({"geofence": {"max_x": "far"}}, "geofence.max_x"),
    ],
)
def test_bad_limits_are_one_clear_error(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        RobotConfig(**fields)


def test_an_acceleration_that_is_not_named_has_its_default() -> None:
    config = RobotConfig.preset("acsar")
    linear, angular = read_both_limits(RobotConfig(linear_limits={"max_velocity": 0.2}))
    assert (linear.max_velocity, linear.max_acceleration, linear.min_acceleration) == (
        0.2,
        2.0,
        -2.0,
    )
    assert (angular.max_velocity, angular.max_acceleration) == (config.max_angular, 8.0)
    assert read_both_limits(config)[0].max_velocity == config.max_linear
    nothing = {"max_acceleration": None}
    assert is_unlimited(RobotConfig(linear_limits=nothing, angular_limits=nothing))
    assert not is_unlimited(RobotConfig(linear_limits=nothing))


def test_limits_are_numbers() -> None:
    assert read_limits(SpeedLimits(max_velocity=0.5)) == AxisLimits()._replace(
        min_velocity=-0.5, max_velocity=0.5
    )
