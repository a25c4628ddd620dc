"""Shapes of the robot from above, in its base frame [m]."""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import border_distance
from acsar_gym.render.backdrop import FLOOR
from acsar_gym.render.canvas import Colour, Floats

CHASSIS: Colour = (41, 89, 148)
DECK: Colour = (217, 224, 233)
TYRE: Colour = (30, 31, 34)


def parts(config: RobotConfig) -> list[tuple[Floats, Colour]]:
    """Return the corners (N, 2) in the base frame [m] and the colours of the robot's parts.

    They are in drawing order: footprint, wheels, chassis, heading and LiDAR.
    """
    body, a, b = config.body, config.wheelbase / 2.0, config.wheel_separation / 2.0
    tyre = max(0.02, body.width - config.wheel_separation)
    inner = max(0.02, config.wheel_separation - tyre - 0.02)
    wheels = [
        (_box(x, y, 2.0 * config.wheel_radius, tyre), TYRE)
        for x, y in ((a, -b), (a, b), (-a, b), (-a, -b))
    ]
    nose = np.array([[0.46, 0.0], [0.12, 0.36], [0.12, -0.36]]) * (body.length, inner)
    turn = np.linspace(0.0, math.tau, 16, endpoint=False)
    sensor = np.array([[config.lidar_x_offset, config.lidar_y_offset]])
    chassis = _box(0.0, 0.0, body.length, inner)
    if config.footprint is not None:
        chassis, room = 0.75 * footprint(config), border_distance(config.footprint, 0.0, 0.0)
        nose = np.array([[0.6, 0.0], [0.0, 0.4], [0.0, -0.4]]) * room
    return [
        (footprint(config), DECK),
        *wheels,
        (chassis, CHASSIS),
        (nose, FLOOR),
        (sensor + polar(turn, np.full(16, 0.035)), TYRE),
    ]


def footprint(config: RobotConfig) -> Floats:
    """Return the corners of the footprint (N, 2) in the base frame [m]."""
    body = config.body
    if config.footprint is None:
        return _box(0.0, 0.0, body.length, body.width)
    return np.array(config.footprint)


def _box(x: float, y: float, length: float, width: float) -> Floats:
    """Return the corners of a rectangle around (x, y) [m]."""
    corners = np.array([[0.5, 0.5], [0.5, -0.5], [-0.5, -0.5], [-0.5, 0.5]])
    box: Floats = corners * (length, width) + (x, y)
    return box


def polar(angles: Floats, ranges: Floats) -> Floats:
    """Convert angles (N,) [rad] and distances (N,) [m] to points (N, 2) [m]."""
    return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles)])
