from __future__ import annotations

import math
import random
from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import samples

from acsar_gym.errors import CommandError, ConfigError
from acsar_gym.odometry import Odometry

RADIUS, SEPARATION = 0.05, 0.3
FORWARD = (10.0, 10.0, 10.0, 10.0)
LEFT_ARC = (12.0, 8.0, 8.0, 12.0)

wheel_speed = st.floats(-100, 100)
four_speeds = st.tuples(wheel_speed, wheel_speed, wheel_speed, wheel_speed)


@dataclass
class Listing:
    """The document's listings (1) to (10), line by line."""

    radius: float
    separation: float
    x: float = 0.0
    y: float = 0.0
    theta: float = 0.0
    linear_vel_x: float = 0.0
    angular_vel_z: float = 0.0
    positions: list[float] = field(default_factory=lambda: [0.0] * 4)

    def read(self, states: tuple[float, float, float, float], dt: float) -> None:
        front_right, front_left, rear_left, rear_right = (s * self.radius for s in states)
        left = (front_left + rear_left) / 2.0
        right = (front_right + rear_right) / 2.0
        self.linear_vel_x = (left + right) / 2.0
        self.angular_vel_z = (right - left) / self.separation
        delta_x = self.linear_vel_x * math.cos(self.theta) * dt
        delta_y = self.linear_vel_x * math.sin(self.theta) * dt
        delta_theta = self.angular_vel_z * dt
        self.x += delta_x
        self.y += delta_y
        self.theta += delta_theta
        while self.theta > math.pi:
            self.theta -= 2 * math.pi
        while self.theta < -math.pi:
            self.theta += 2 * math.pi
        for i in range(4):
            self.positions[i] += states[i] * dt


def apart(odometry: Odometry, listing: Listing) -> float:
    """The largest difference of any number that both integrate."""
    x, y, theta = odometry.pose
    linear, angular = odometry.twist
    turn = math.remainder(theta - listing.theta, 2 * math.pi)
    wheels = zip(odometry.wheel_positions, listing.positions, strict=True)
    return max(
        abs(x - listing.x),
        abs(y - listing.y),
        abs(turn),
        abs(linear - listing.linear_vel_x),
        abs(angular - listing.angular_vel_z),
        *(abs(mine - theirs) for mine, theirs in wheels),
    )


def state(odometry: Odometry) -> tuple[object, ...]:
    return odometry.pose, odometry.twist, odometry.wheel_positions, odometry.quaternion


@samples(10_000, 100_000)
def test_random_updates_agree_with_the_documents_listings(count: int) -> None:
    rng = random.Random(20250609)
    odometry, listing = Odometry(RADIUS, SEPARATION), Listing(RADIUS, SEPARATION)
    worst = 0.0
    for _ in range(count):
        a, b, c, d = (rng.uniform(-30, 30) for _ in range(4))
        dt = rng.uniform(0.0, 0.02)
        odometry.update((a, b, c, d), dt)
        listing.read((a, b, c, d), dt)
        worst = max(worst, apart(odometry, listing))
    assert worst < 1e-9
    assert math.hypot(*odometry.pose[:2]) > 0.1


@pytest.mark.parametrize(
    ("turn", "theta"),
    [
        (math.pi, math.pi),
        (-math.pi, -math.pi),
        (math.nextafter(math.pi, 4.0), -math.pi),
        (math.nextafter(-math.pi, -4.0), math.pi),
        (1.5 * math.pi, -0.5 * math.pi),
        (-5.5 * math.pi, 0.5 * math.pi),
        *((k * math.pi, math.copysign(math.pi, k)) for k in (3, -3, 5, -7)),
    ],
)
def test_equation_10_wraps_only_beyond_pi(turn: float, theta: float) -> None:
    odometry = Odometry(1.0, 1.0)
    odometry.update((turn, 0.0, 0.0, turn), 1.0)
    assert odometry.pose[2] == pytest.approx(theta, abs=1e-12)


@given(speeds=four_speeds, dt=st.floats(0, 1))
def test_the_quaternion_is_equation_11_and_of_unit_length(
    speeds: tuple[float, float, float, float], dt: float
) -> None:
    odometry = Odometry(RADIUS, SEPARATION)
    odometry.update(speeds, dt)
    theta = odometry.pose[2]
    x, y, z, w = odometry.quaternion
    assert (x, y) == (0.0, 0.0)
    assert (z, w) == pytest.approx((math.sin(theta / 2), math.cos(theta / 2)))
    assert z * z + w * w == pytest.approx(1.0)
    assert (w * w - z * z, 2 * w * z) == pytest.approx((math.cos(theta), math.sin(theta)), abs=1e-9)


@given(speeds=four_speeds, multiplier=st.floats(0.5, 3.0))
def test_the_multiplier_scales_the_separation_and_nothing_else(
    speeds: tuple[float, float, float, float], multiplier: float
) -> None:
    plain, skidding = Odometry(RADIUS, SEPARATION), Odometry(RADIUS, SEPARATION, multiplier)
    wider = Odometry(RADIUS, SEPARATION * multiplier)
    for odometry in (plain, skidding, wider):
        odometry.update(speeds, 0.01)
    assert state(skidding) == state(wider)
    assert skidding.twist[0] == plain.twist[0]
    assert skidding.twist[1] * multiplier == pytest.approx(plain.twist[1])


@pytest.mark.parametrize(
    ("speeds", "dt"),
    [
        ((math.nan, 0.0, 0.0, 0.0), 0.01),
        ((0.0, math.inf, 0.0, 0.0), 0.01),
        (FORWARD, -0.001),
        (FORWARD, math.nan),
        ((1e308,) * 4, 1e300),
        ((1.0,) * 3, 0.01),
    ],
)
def test_what_cannot_be_integrated_is_refused_and_changes_nothing(
    speeds: tuple[float, ...], dt: float
) -> None:
    odometry = Odometry(RADIUS, SEPARATION)
    odometry.update(LEFT_ARC, 0.1)
    before = state(odometry)
    with pytest.raises(CommandError):
        odometry.update(speeds, dt)
    assert state(odometry) == before


def test_wheels_of_each_side_have_their_own_radius() -> None:
    odometry = Odometry(
        0.05,
        0.3,
        1.5,
        left_wheel_radius_multiplier=0.98,
        right_wheel_radius_multiplier=1.01,
    )
    odometry.update((10.0, 10.0, 10.0, 10.0), 0.1)
    left, right = 10.0 * 0.05 * 0.98, 10.0 * 0.05 * 1.01
    assert odometry.twist == pytest.approx(((left + right) / 2.0, (right - left) / (0.3 * 1.5)))
    with pytest.raises(ConfigError, match="right_wheel_radius_multiplier"):
        Odometry(0.05, 0.3, right_wheel_radius_multiplier=0.0)
