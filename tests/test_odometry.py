"""Odometry against the listings of the robot's hardware interface document."""

from __future__ import annotations

import math
import random

import pytest
from samples import samples

from acsar_gym import RobotConfig
from acsar_gym.errors import CommandError, ConfigError
from acsar_gym.odometry import Odometry

RADIUS = 0.05
SEPARATION = 0.3
FORWARD = (10.0, 10.0, 10.0, 10.0)
LEFT_ARC = (12.0, 8.0, 8.0, 12.0)


class Listing:
    """The document's listings (1) to (10), line by line."""

    def __init__(self) -> None:
        self.x = self.y = self.theta = 0.0
        self.linear_vel_x = self.angular_vel_z = 0.0
        self.positions = [0.0] * 4

    def read(self, states: tuple[float, float, float, float], dt: float) -> None:
        front_right, front_left, rear_left, rear_right = (s * RADIUS for s in states)
        left_speed = (front_left + rear_left) / 2.0
        right_speed = (front_right + rear_right) / 2.0
        self.linear_vel_x = (left_speed + right_speed) / 2.0
        self.angular_vel_z = (right_speed - left_speed) / SEPARATION

        self.x += self.linear_vel_x * math.cos(self.theta) * dt
        self.y += self.linear_vel_x * math.sin(self.theta) * dt
        self.theta += self.angular_vel_z * dt
        while self.theta > math.pi:
            self.theta -= 2 * math.pi
        while self.theta < -math.pi:
            self.theta += 2 * math.pi
        for i in range(4):
            self.positions[i] += states[i] * dt


@samples(10_000, 100_000)
def test_update_agrees_with_the_listings(count: int) -> None:
    rng = random.Random(20250609)
    odometry = Odometry(RADIUS, SEPARATION)
    listing = Listing()
    for _ in range(count):
        speeds = (rng.uniform(-30, 30), rng.uniform(-30, 30), rng.uniform(-30, 30), 5.0)
        dt = rng.uniform(0.0, 0.02)
        odometry.update(speeds, dt)
        listing.read(speeds, dt)

        x, y, theta = odometry.pose
        assert math.hypot(x - listing.x, y - listing.y) < 1e-9
        assert abs(math.remainder(theta - listing.theta, 2 * math.pi)) < 1e-9
        assert odometry.twist == pytest.approx((listing.linear_vel_x, listing.angular_vel_z))
        assert odometry.wheel_positions == pytest.approx(listing.positions, abs=1e-9)
    assert math.hypot(*odometry.pose[:2]) > 0.1


@pytest.mark.parametrize(
    ("turn", "theta"),
    [
        (math.pi, math.pi),
        (math.nextafter(math.pi, 4.0), -math.pi),
        (-5.5 * math.pi, 0.5 * math.pi),
        (3 * math.pi, math.pi),
    ],
)
def test_update_wraps_only_beyond_pi(turn: float, theta: float) -> None:
    odometry = Odometry(1.0, 1.0)
    odometry.update((turn, 0.0, 0.0, turn), 1.0)
    assert odometry.pose[2] == pytest.approx(theta, abs=1e-12)


def test_quaternion_is_equation_11() -> None:
    odometry = Odometry(RADIUS, SEPARATION)
    odometry.update(LEFT_ARC, dt=1.0)
    half = odometry.pose[2] / 2
    assert odometry.quaternion == (0.0, 0.0, math.sin(half), math.cos(half))


@pytest.mark.parametrize(
    ("speeds", "dt"),
    [
        ((math.nan, 0.0, 0.0, 0.0), 0.01),
        (FORWARD, -0.001),
        (FORWARD, math.nan),
        ((1e308,) * 4, 1e300),
        ((1.0,) * 3, 0.01),
    ],
)
def test_update_refuses_bad_numbers_and_changes_nothing(
    speeds: tuple[float, ...], dt: float
) -> None:
    odometry = Odometry(RADIUS, SEPARATION)
    odometry.update(LEFT_ARC, 0.1)
    old = dict(vars(odometry))
    with pytest.raises(CommandError):
        odometry.update(speeds, dt)
    assert vars(odometry) == old


def test_of_takes_a_radius_for_each_side() -> None:
    config = RobotConfig(
        wheel_radius=RADIUS,
        wheel_separation=SEPARATION,
        wheel_separation_multiplier=1.5,
        left_wheel_radius_multiplier=0.98,
        right_wheel_radius_multiplier=1.01,
    )
    odometry = Odometry.of(config)
    odometry.update(FORWARD, 0.1)
    left_speed = 10.0 * RADIUS * 0.98
    right_speed = 10.0 * RADIUS * 1.01
    turn_rate = (right_speed - left_speed) / (SEPARATION * 1.5)
    assert odometry.twist == pytest.approx(((left_speed + right_speed) / 2.0, turn_rate))


def test_odometry_refuses_a_length_of_zero() -> None:
    with pytest.raises(ConfigError, match="wheel_separation = 0"):
        Odometry(0.05, 0.0)
