"""Scans of a robot that moves while its LiDAR turns."""

from __future__ import annotations

import math

import numpy as np
import pytest

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.sensors.lidar import READ_DELAY, Floats, LidarSensor, Turn, bin_ranges, scan_turn
from acsar_gym.sensors.rplidar import RplidarLidar

SAMPLES, PERIOD = 720, 0.1
MOUNT = (0.08, -0.02)
CONFIG = RobotConfig().with_(
    lidar_x_offset=MOUNT[0], lidar_y_offset=MOUNT[1], lidar={"noise": 0.0, "rays": 64}
)
WALLS = ((1.0, 0.0, 1.5), (-1.0, 0.0, 2.0), (0.0, 1.0, 1.0), (0.0, -1.0, 1.2))
"""Normal and distance of each wall of a room."""
TWISTS = [(0.5, 0.0), (0.5, 1.2), (0.5, -1.2), (0.0, 1.5), (-0.3, -0.5)]


def pose(twist: tuple[float, float], time: float) -> tuple[float, float, float]:
    """Where a robot is that is at the origin at time 0, by small steps."""
    x = y = theta = 0.0
    for _ in range(200):
        x += twist[0] * time / 200 * math.cos(theta + twist[1] * time / 400)
        y += twist[0] * time / 200 * math.sin(theta + twist[1] * time / 400)
        theta += twist[1] * time / 200
    return x, y, theta


def distance(place: tuple[float, float, float], bearing: float, walls: int = 4) -> float:
    """Distance from the LiDAR of a robot to the walls of a room; 0 where there is none."""
    x, y, theta = place
    x += math.cos(theta) * MOUNT[0] - math.sin(theta) * MOUNT[1]
    y += math.sin(theta) * MOUNT[0] + math.cos(theta) * MOUNT[1]
    found = math.inf
    for nx, ny, far in WALLS[:walls]:
        along = nx * math.cos(theta + bearing) + ny * math.sin(theta + bearing)
        if along > 1e-9:
            found = min(found, (far - nx * x - ny * y) / along)
    return found if found < 5.0 else 0.0


def turn(twist: tuple[float, float], walls: int = 4, angle: bool = True) -> Turn:
    """A revolution, clockwise from straight ahead, that ends when the robot is at the origin."""
    bearings = -2.0 * math.pi * np.arange(SAMPLES) / SAMPLES
    times = -PERIOD * np.arange(SAMPLES, 0, -1) / SAMPLES
    measured = [
        distance(pose(twist, time), bearing, walls)
        for time, bearing in zip(times.tolist(), bearings.tolist(), strict=True)
    ]
    distances = np.array(measured)
    return np.where(angle | (distances > 0.0), bearings, 0.0), distances


def exact(twist: tuple[float, float], walls: int = 4) -> Floats:
    """The ranges half a revolution later."""
    place, spec = pose(twist, READ_DELAY * PERIOD), CONFIG.lidar
    angles = -math.pi + 2.0 * math.pi * np.arange(spec.rays) / spec.rays
    found = np.array([distance(place, angle, walls) for angle in angles.tolist()])
    return np.where(found > 0.0, found, spec.max_range)


@pytest.mark.parametrize("twist", TWISTS)
def test_a_scan_is_as_seen_where_the_robot_is_half_a_turn_later(
    twist: tuple[float, float],
) -> None:
    expected = exact(twist)
    found = scan_turn(turn(twist), PERIOD, twist, CONFIG)
    unmoved = bin_ranges(*turn(twist), CONFIG.lidar)
    assert np.abs(found - expected).max() < 0.03
    assert np.abs(unmoved - expected).max() > 0.05


@pytest.mark.parametrize("twist", TWISTS)
@pytest.mark.parametrize("angle", [True, False], ids=["angles", "no angles of misses"])
def test_what_is_free_stays_free_and_no_ray_is_lost(
    twist: tuple[float, float], angle: bool
) -> None:
    free = exact(twist, walls=1) >= CONFIG.lidar.max_range
    found = scan_turn(turn(twist, walls=1, angle=angle), PERIOD, twist, CONFIG)
    wrong = (found >= CONFIG.lidar.max_range) != free
    assert 20 < free.sum() < 60
    assert wrong.sum() <= 2  # at the ends of the wall, where ranges are near the longest
    whole = scan_turn(turn(twist), PERIOD, twist, CONFIG)
    assert whole.max() < CONFIG.lidar.max_range


def test_a_robot_at_rest_has_the_scan_as_it_was_measured_and_nothing_is_free() -> None:
    bearings, distances = turn((0.0, 0.0))
    still = scan_turn((bearings, distances), PERIOD, (0.0, 0.0), CONFIG)
    assert (still == bin_ranges(bearings, distances, CONFIG.lidar)).all()
    found = scan_turn((bearings, np.zeros(SAMPLES)), PERIOD, (0.5, 0.3), CONFIG)
    assert (found == CONFIG.lidar.max_range).all()


def test_a_robot_tells_its_lidar_how_it_moves() -> None:
    lidar = RplidarLidar("/dev/null", CONFIG, lambda: 0.0)
    robot = Robot(open_link("planar", CONFIG), CONFIG, [LidarSensor(lidar, CONFIG)])
    assert lidar._odometry is robot.odometry
