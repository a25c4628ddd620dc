from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsar_gym import kinematics
from acsar_gym.errors import CommandError, ConfigError

RADIUS, SEPARATION = 0.05, 0.3

length = st.floats(0.01, 2.0)
linear_speed = st.floats(-5, 5)
angular_speed = st.floats(-20, 20)


def close(value: float, expected: float) -> bool:
    return math.isclose(value, expected, rel_tol=1e-9, abs_tol=1e-9)


@pytest.mark.parametrize(
    ("speeds", "linear", "angular"),
    [
        ((10.0, 10.0, 10.0, 10.0), 0.5, 0.0),
        ((3.0, -3.0, -3.0, 3.0), 0.0, 1.0),
        ((6.0, 0.0, 0.0, 6.0), 0.15, 1.0),
        ((4.0, 0.0, 0.0, 0.0), 0.05, 1.0 / 3.0),
        ((0.0, 4.0, 0.0, 0.0), 0.05, -1.0 / 3.0),
        ((0.0, 0.0, 4.0, 0.0), 0.05, -1.0 / 3.0),
        ((0.0, 0.0, 0.0, 4.0), 0.05, 1.0 / 3.0),
    ],
)
def test_each_wheel_stands_where_the_wheel_order_says(
    speeds: tuple[float, float, float, float], linear: float, angular: float
) -> None:
    assert kinematics.forward(speeds, RADIUS, SEPARATION) == pytest.approx((linear, angular))


@given(linear=linear_speed, angular=angular_speed, radius=length, separation=length)
def test_forward_of_inverse_is_the_twist(
    linear: float, angular: float, radius: float, separation: float
) -> None:
    speeds = kinematics.inverse(linear, angular, radius, separation)
    back = kinematics.forward(speeds, radius, separation)
    assert close(back[0], linear)
    assert close(back[1], angular)


@given(linear=linear_speed, angular=angular_speed, left=length, right=length)
def test_wheels_of_each_side_have_their_own_radius(
    linear: float, angular: float, left: float, right: float
) -> None:
    sizes = {"left_wheel_radius_multiplier": left, "right_wheel_radius_multiplier": right}
    speeds = kinematics.inverse(linear, angular, RADIUS, SEPARATION, **sizes)
    a, b, c, d = kinematics.inverse(linear, angular, RADIUS, SEPARATION)
    assert speeds == pytest.approx((a / right, b / left, c / left, d / right))
    back = kinematics.forward(speeds, RADIUS, SEPARATION, **sizes)
    assert close(back[0], linear)
    assert close(back[1], angular)


def test_limits_of_the_inverse() -> None:
    free = kinematics.inverse(0.5, 1.0, RADIUS, SEPARATION)
    assert free == pytest.approx((13.0, 7.0, 7.0, 13.0))
    assert kinematics.inverse(0.5, 1.0, RADIUS, SEPARATION, 13.0) == free
    assert kinematics.inverse(1.0, -2.0, RADIUS, SEPARATION, 0.0) == (0.0, 0.0, 0.0, 0.0)
    with pytest.raises(ConfigError, match="multiplier"):
        kinematics.inverse(0.1, 0.0, RADIUS, SEPARATION, left_wheel_radius_multiplier=0.0)
    with pytest.raises(CommandError, match="twist"):
        kinematics.inverse(1e308, 1e308, 0.05, 0.3, 30.0)
