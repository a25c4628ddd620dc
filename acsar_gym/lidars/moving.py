"""The scan of a robot that moved while its LiDAR turned, as from a single pose.

A revolution takes 0.1 s, in which a robot of 0.5 m/s drives 5 cm and turns by some degrees, and
it is the newest one for 0.1 s more. A simulated scan is taken at once. So every measurement is
moved by what the robot drove since, or will have driven, at its present twist.
"""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.lidars.revolutions import SURE, Floats, Turn, binned

AHEAD = 0.5
"""When a scan is read, in revolutions after its end: at any time from 0 to 1."""
LOOSE = 2.0
"""Steps between two measurements that driving may leave between them."""
Twist = tuple[float, float]


def scanned(turn: Turn, duration: float, twist: Twist, config: RobotConfig) -> Floats:
    """Compute the ranges of a scan from one revolution of a robot that moves.

    They are as seen from where the robot will be half a revolution after the end of this one.

    Args:
        turn: the revolution.
        duration: of it [s].
        twist: of the robot at its end, linear [m/s] and angular [rad/s].
        config: of the robot.

    Returns:
        (rays,) [m], within min_range to max_range.
    """
    bearings, distances = turn
    count = len(bearings)
    if twist == (0.0, 0.0) or not count:
        return binned(bearings, distances, config.lidar)
    ages = ((np.arange(count, 0, -1) + SURE) / count + AHEAD) * duration
    mount = (config.lidar_x_offset, config.lidar_y_offset)
    gap = LOOSE * 2.0 * math.pi / count + abs(twist[1]) * duration
    moved = _moved(_placed(bearings, distances), distances, ages, twist, mount)
    return binned(*moved, config.lidar, gap)


def _placed(bearings: Floats, distances: Floats) -> Floats:
    """Bearings, even ones where nothing was measured: an RPLIDAR gives no valid angle there."""
    (measured,) = np.nonzero(distances)
    if not len(measured):
        return bearings
    first, count = measured[0], len(bearings)
    even = bearings[first] - (np.arange(count) - first) * 2.0 * math.pi / count
    return np.where(distances > 0.0, bearings, even)


def _moved(
    bearings: Floats, distances: Floats, ages: Floats, twist: Twist, mount: tuple[float, float]
) -> Turn:
    """Bearings and distances after the robot drove for `ages` [s] on an arc; 0 stays 0.

    Args:
        bearings: in the LiDAR's frame [rad].
        distances: [m].
        ages: time since each was measured [s].
        twist: linear [m/s] and angular [rad/s].
        mount: place of the LiDAR in the base frame [m].
    """
    linear, angular = twist
    turned = angular * ages
    chord = linear * ages * np.sinc(turned / 2.0 / math.pi)
    x = mount[0] + distances * np.cos(bearings) - chord * np.cos(turned / 2.0)
    y = mount[1] + distances * np.sin(bearings) - chord * np.sin(turned / 2.0)
    cos, sin = np.cos(turned), np.sin(turned)
    x, y = cos * x + sin * y - mount[0], cos * y - sin * x - mount[1]
    measured = distances > 0.0
    seen = np.where(measured, np.arctan2(y, x), bearings - turned)
    return seen, np.where(measured, np.hypot(x, y), 0.0)
