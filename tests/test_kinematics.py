"""Twists of wheel speeds and wheel speeds of twists."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsar_gym import kinematics
from acsar_gym.errors import CommandError, ConfigError

RADIUS = 0.05
SEPARATION = 0.3

length = st.floats(0.01, 2.0)
linear_speed = st.floats(-5, 5)
angular_speed = st.floats(-20, 20)


@pytest.mark.parametrize(
    ("speeds", "linear", "angular"),
    [
        ((10.0, 10.0, 10.0, 10.0), 0.5, 0.0),
        ((3.0, -3.0, -3.0, 3.0), 0.0, 1.0),
        ((4.0, 0.0, 0.0, 0.0), 0.05, 1.0 / 3.0),
        ((0.0, 0.0, 4.0, 0.0), 0.05, -1.0 / 3.0),
    ],
)
def test_forward_follows_the_wheel_order(
    speeds: tuple[float, float, float, float], linear: float, angular: float
) -> None:
    assert kinematics.forward(speeds, RADIUS, SEPARATION) == pytest.approx((linear, angular))


@given(linear=linear_speed, angular=angular_speed, radius=length, separation=length)
def test_forward_of_inverse_is_the_twist(
    linear: float, angular: float, radius: float, separation: float
) -> None:
    speeds = kinematics.inverse(linear, angular, radius, separation)
    twist = kinematics.forward(speeds, radius, separation)
    assert twist == pytest.approx((linear, angular), rel=1e-9, abs=1e-9)


@given(linear=linear_speed, angular=angular_speed, left=length, right=length)
def test_compute_speeds_takes_a_radius_for_each_side(
    linear: float, angular: float, left: float, right: float
) -> None:
    sizes = {"left_radius": left, "right_radius": right, "wheel_separation": SEPARATION}
    speeds = kinematics.compute_speeds(linear, angular, **sizes, max_speed=1e9)
    a, b, c, d = kinematics.inverse(linear, angular, 1.0, SEPARATION)
    assert speeds == pytest.approx((a / right, b / left, c / left, d / right))
    twist = kinematics.compute_twist(*speeds, **sizes)
    assert twist == pytest.approx((linear, angular), rel=1e-9, abs=1e-9)


def test_inverse_has_limits() -> None:
    speeds = kinematics.inverse(0.5, 1.0, RADIUS, SEPARATION)
    assert speeds == pytest.approx((13.0, 7.0, 7.0, 13.0))
    assert kinematics.inverse(0.5, 1.0, RADIUS, SEPARATION, max_speed=13.0) == speeds
    assert kinematics.inverse(1.0, -2.0, RADIUS, SEPARATION, max_speed=0.0) == (0.0,) * 4
    with pytest.raises(ConfigError, match="wheel_radius"):
        kinematics.inverse(0.1, 0.0, 0.0, SEPARATION)
    with pytest.raises(CommandError, match="twist"):
        kinematics.inverse(1e308, 1e308, RADIUS, SEPARATION, max_speed=30.0)
