"""Scans of a robot that moves while its LiDAR turns: measurements of a room, moved and sorted."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsar_gym import RobotConfig
from acsar_gym.lidar.scan import Floats, Revolution, Trail, fill_scan, make_rays

MEASUREMENTS = 720
DURATION = 0.1
MOUNT = 0.08 - 0.02j
CONFIG = RobotConfig().with_(
    lidar_x_offset=MOUNT.real, lidar_y_offset=MOUNT.imag, lidar={"noise": 0.0, "rays": 64}
)
WALLS = ((1.0, 1.5), (-1.0, 2.0), (1.0j, 1.0), (-1.0j, 1.2))
"""Normal and distance of each wall of a room."""
Twist = tuple[float, float]
TWISTS = [(0.5, 0.0), (0.5, 1.2), (0.0, 1.5), (-0.3, -0.5), (0.0, 0.0)]
STANDSTILL = (0.0, 0.0)


def drive(twist: Twist, time: float) -> tuple[complex, float]:
    """Place and heading on an arc that passes the origin at time 0."""
    turned = twist[1] * time
    chord = twist[0] * time * float(np.sinc(turned / 2.0 / math.pi))
    return chord * np.exp(0.5j * turned), turned


def measure(place: complex, heading: float, bearing: float) -> float:
    """Distance from the LiDAR of a robot to the walls."""
    place += MOUNT * np.exp(1j * heading)
    beam = np.exp(1j * (heading + bearing))
    distances = []
    for normal, wall in WALLS:
        along = (beam / normal).real
        if along > 1e-9:
            distances.append((wall - (place / normal).real) / along)
    return float(min(distances))


def revolve(twist: Twist, ended: float) -> Revolution:
    """A revolution, clockwise from 0.3 rad, of a robot on an arc."""
    bearings = 0.3 - 2.0 * math.pi * np.arange(MEASUREMENTS) / MEASUREMENTS
    times = ended - DURATION * np.arange(MEASUREMENTS, 0, -1) / MEASUREMENTS
    distances = [measure(*drive(twist, time), b) for time, b in zip(times, bearings, strict=True)]
    return Revolution(bearings, np.array(distances), times, ended)


def scan(
    revolution: Revolution,
    twist: Twist,
    start: tuple[complex, float] = (0j, 0.0),
    config: RobotConfig = CONFIG,
) -> Floats:
    """The ranges at time 0 by odometry that started anywhere."""
    trail = Trail(0.5, 0.01)
    for tick in range(-60, 1):
        place, heading = drive(twist, tick * 0.01)
        place = start[0] + place * np.exp(1j * start[1])
        heading = math.remainder(start[1] + heading, math.tau)
        trail.mark(tick * 0.01, (place.real, place.imag, heading))
    ranges = np.empty(config.lidar.rays)
    fill_scan(revolution, trail.ring, make_rays(config), ranges)
    return ranges


def exact(config: RobotConfig = CONFIG) -> Floats:
    """The ranges of a robot at the origin."""
    rays = make_rays(config)
    return np.array([measure(0j, 0.0, rays.start + k * rays.step) for k in range(64)])


@pytest.mark.parametrize("start", [(0j, 0.0), (3.0 - 2.0j, 3.1)], ids=["origin", "elsewhere"])
@pytest.mark.parametrize("ended", [0.0, -0.03, -0.099])
@pytest.mark.parametrize("twist", TWISTS)
def test_fill_scan_is_as_seen_from_the_present_pose(
    twist: Twist, ended: float, start: tuple[complex, float]
) -> None:
    """A robot that turns against the head leaves a gap between the ends of a revolution, which two
    rays may meet."""
    errors = np.sort(np.abs(scan(revolve(twist, ended), twist, start) - exact()))
    assert errors[-3] < 0.03
    assert errors[-1] < 0.15
    if twist != STANDSTILL:
        unmoved = scan(revolve(twist, ended), STANDSTILL)
        assert np.abs(unmoved - exact()).max() > 0.04


def test_fill_scan_leaves_a_long_gap_free() -> None:
    still = revolve(STANDSTILL, 0.0)
    gap = np.abs(np.remainder(still.bearings + math.pi, 2.0 * math.pi) - math.pi) < 0.5
    ranges = scan(Revolution._make([*np.array(still[:3])[:, ~gap], 0.0]), STANDSTILL)
    angles = np.abs(-math.pi + 2.0 * math.pi * np.arange(64) / 64)
    assert (ranges[angles < 0.4] == CONFIG.lidar.max_range).all()
    assert (ranges[angles > 0.55] < CONFIG.lidar.max_range).all()
    assert (scan(Revolution._make([*np.zeros((3, 0)), 0.0]), STANDSTILL) == 5.0).all()


@pytest.mark.parametrize("view", [1.0, 6.0])
def test_fill_scan_fills_a_part_of_a_turn(view: float) -> None:
    config = CONFIG.with_(lidar={"field_of_view": view})
    ranges = scan(revolve((0.3, 0.8), -0.02), (0.3, 0.8), config=config)
    assert np.sort(np.abs(ranges - exact(config)))[-3] < 0.03


@given(st.data())
def test_fill_scan_interpolates_between_neighbours(data: Any) -> None:
    """Or the range of the nearer measurement, if they can't lie on one surface."""
    rays = make_rays(CONFIG)
    count = data.draw(st.sampled_from([40, 64, 200, 720]))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    bearings = np.sort(rng.uniform(-math.pi, math.pi, count))
    distances = rng.choice([1.0, 1.01, 1.02, 4.0], count)
    order = rng.permutation(count)
    turned = 2.0 * math.pi * data.draw(st.integers(-2, 2))
    shuffled = Revolution(bearings[order] + turned, distances[order], np.zeros(count), 0.0)
    ranges = scan(shuffled, STANDSTILL)

    for k, measured in enumerate(ranges.tolist()):
        angle = rays.start + k * rays.step
        gaps = np.remainder(bearings - angle + math.pi, 2.0 * math.pi) - math.pi
        sides = [np.argmax(1.0 / gaps), np.argmin(1.0 / gaps)]
        low, high = np.sort(distances[sides])
        near, distant = np.sort(np.abs(gaps[sides]))
        if near > 4.0 * math.pi / count - 1e-6 or distant - near < 1e-6:
            continue  # nothing may be in reach, or two measurements are as near
        assert low - 1e-9 <= measured <= high + 1e-9
        if high == 4.0:
            assert measured == pytest.approx(distances[np.abs(gaps).argmin()])


@pytest.mark.parametrize(
    ("rise", "expected"),
    [(0.029, 1.00725), (-0.028, 0.993), (0.031, 1.0), (-0.031, 1.0)],
)
def test_fill_scan_interpolates_on_a_surface_of_a_limited_slope(
    rise: float, expected: float
) -> None:
    """Two measurements are 0.01 rad apart, so that their distances may differ by 3 %."""
    bearings = np.array([-0.0025, 0.0075])
    still = Revolution(bearings, np.array([1.0, 1.0 + rise]), np.zeros(2), 0.0)
    assert scan(still, STANDSTILL)[32] == pytest.approx(expected, abs=1e-9)
