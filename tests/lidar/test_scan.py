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

MEASUREMENTS, DURATION = 720, 0.1
MOUNT = (0.08, -0.02)
CONFIG = RobotConfig().with_(
    lidar_x_offset=MOUNT[0], lidar_y_offset=MOUNT[1], lidar={"noise": 0.0, "rays": 64}
)
WALLS = ((1.0, 0.0, 1.5), (-1.0, 0.0, 2.0), (0.0, 1.0, 1.0), (0.0, -1.0, 1.2))
"""Normal and distance of each wall of a room."""
TWISTS = [(0.5, 0.0), (0.5, 1.2), (0.5, -1.2), (0.0, 1.5), (-0.3, -0.5), (0.0, 0.0)]
Pose = tuple[float, float, float]


def drive(twist: tuple[float, float], time: float) -> Pose:
    """Where a robot is that is at the origin at time 0, on an arc."""
    turned = twist[1] * time
    chord = twist[0] * time * float(np.sinc(turned / 2.0 / math.pi))
    return chord * math.cos(turned / 2.0), chord * math.sin(turned / 2.0), turned


def measure(place: Pose, bearing: float, walls: int = 4) -> float:
    """Distance from the LiDAR of a robot to the walls of a room; 0 where there is none."""
    x, y, theta = place
    x += math.cos(theta) * MOUNT[0] - math.sin(theta) * MOUNT[1]
    y += math.sin(theta) * MOUNT[0] + math.cos(theta) * MOUNT[1]
    found = math.inf
    for nx, ny, far in WALLS[:walls]:
        along = nx * math.cos(theta + bearing) + ny * math.sin(theta + bearing)
        if along > 1e-9:
            found = min(found, (far - nx * x - ny * y) / along)
    return found if found < CONFIG.lidar.max_range else 0.0


def revolve(
    twist: tuple[float, float], ended: float, walls: int = 4, ahead: float = 0.3
) -> Revolution:
    """A revolution, clockwise, while a robot drives that is at the origin at time 0."""
    bearings = ahead - 2.0 * math.pi * np.arange(MEASUREMENTS) / MEASUREMENTS
    times = ended - DURATION * np.arange(MEASUREMENTS, 0, -1) / MEASUREMENTS
    distances = [
        measure(drive(twist, time), bearing, walls)
        for time, bearing in zip(times.tolist(), bearings.tolist(), strict=True)
    ]
    return Revolution(bearings, np.array(distances), times, ended)


def scan(
    revolution: Revolution,
    twist: tuple[float, float],
    start: Pose = (0.0, 0.0, 0.0),
    config: RobotConfig = CONFIG,
) -> Floats:
    """The scan at time 0 of a robot whose odometry began anywhere."""
    trail, ranges = Trail(0.5, 0.01), np.empty(config.lidar.rays)
    cos, sin = math.cos(start[2]), math.sin(start[2])
    for tick in range(-60, 1):
        x, y, theta = drive(twist, tick * 0.01)
        theta = math.remainder(start[2] + theta, math.tau)
        trail.mark(tick * 0.01, (start[0] + cos * x - sin * y, start[1] + sin * x + cos * y, theta))
    fill_scan(*revolution[:3], trail.rows, trail.newest, make_rays(config), ranges)
    return ranges


def exact(walls: int = 4, config: RobotConfig = CONFIG) -> Floats:
    """The ranges of a robot at the origin."""
    rays = make_rays(config)
    found = [measure((0.0, 0.0, 0.0), rays.start + k * rays.step, walls) for k in range(64)]
    return np.where(np.array(found) > 0.0, found, config.lidar.max_range)


@pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (3.0, -2.0, 3.1)], ids=["origin", "elsewhere"])
@pytest.mark.parametrize("ended", [0.0, -0.03, -0.099])
@pytest.mark.parametrize("twist", TWISTS)
def test_a_scan_is_as_seen_from_where_the_robot_is_now(
    twist: tuple[float, float], ended: float, start: Pose
) -> None:
    """A robot that turns against the head leaves a gap between the ends of a revolution, which two
    rays may meet."""
    off = np.sort(np.abs(scan(revolve(twist, ended), twist, start) - exact()))
    assert off[-3] < 0.03
    assert off[-1] < 0.15
    if twist != (0.0, 0.0):
        unmoved = scan(revolve(twist, ended), (0.0, 0.0))
        assert np.abs(unmoved - exact()).max() > 0.04


def test_where_nothing_was_measured_for_long_is_free() -> None:
    still = revolve((0.0, 0.0), 0.0)
    gap = np.abs(np.remainder(still.bearings + math.pi, 2.0 * math.pi) - math.pi) < 0.5
    kept = Revolution(still.bearings[~gap], still.distances[~gap], still.times[~gap], 0.0)
    found, angles = scan(kept, (0.0, 0.0)), -math.pi + 2.0 * math.pi * np.arange(64) / 64
    assert (found[np.abs(angles) < 0.4] == CONFIG.lidar.max_range).all()
    assert (found[np.abs(angles) > 0.55] < CONFIG.lidar.max_range).all()
    nothing = np.zeros(0)
    assert (scan(Revolution(nothing, nothing, nothing, 0.0), (0.0, 0.0)) == 5.0).all()


@pytest.mark.parametrize("view", [1.0, 3.0, 6.0])
def test_rays_of_a_part_of_a_turn(view: float) -> None:
    config = CONFIG.with_(lidar={"field_of_view": view})
    found = scan(revolve((0.3, 0.8), -0.02), (0.3, 0.8), config=config)
    assert np.sort(np.abs(found - exact(config=config)))[-3] < 0.03


@given(st.data())
def test_each_ray_has_what_lies_between_the_measurements_next_to_it(data: Any) -> None:
    """At rest; or what the nearer one of the two has, where they can't lie on one surface."""
    rays, count = make_rays(CONFIG), data.draw(st.sampled_from([40, 64, 200, 720]))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    bearings = np.sort(rng.uniform(-math.pi, math.pi, count))
    distances = rng.choice([1.0, 1.01, 1.02, 4.0], count)
    order, turned = rng.permutation(count), 2.0 * math.pi * data.draw(st.integers(-2, 2))
    shuffled = Revolution(bearings[order] + turned, distances[order], np.zeros(count), 0.0)
    found = scan(shuffled, (0.0, 0.0))
    for k, ray in enumerate((rays.start + np.arange(64) * rays.step).tolist()):
        off = np.remainder(bearings - ray + math.pi, 2.0 * math.pi) - math.pi
        sides = (
            np.where(off <= 0.0, off, -np.inf).argmax(),
            np.where(off >= 0.0, off, np.inf).argmin(),
        )
        one, two = distances[list(sides)]
        near, far = np.sort(np.abs(off[list(sides)]))
        if near > 4.0 * math.pi / count - 1e-6 or far - near < 1e-6:
            continue  # there may be nothing in reach, or two that are as near
        assert min(one, two) - 1e-9 <= found[k] <= max(one, two) + 1e-9
        if max(one, two) == 4.0:
            assert found[k] == pytest.approx(distances[np.abs(off).argmin()])
