"""Baselines without an env: their setting, observations in SI units, and scans of simple rooms."""

from __future__ import annotations

import math

import numpy as np

from acsar_gym import RobotConfig
from acsar_gym.tasks.state import Floats
from acsar_gym.tools import baselines
from acsar_gym.tools.baselines.base import BaselinePolicy
from acsar_gym.tools.policies.policy import DecodedObservation, PolicyContext
from acsar_gym.worlds.geometry import RaySpec

PERIOD = 0.1
CONFIG = RobotConfig.preset("acsar")
ANGLES = RaySpec(CONFIG.lidar.rays).angles()


def equipped(name: str) -> BaselinePolicy:
    """A baseline for the default robot, at 10 Hz."""
    policy = baselines.load_baseline(name, "acsar_gym/ObstacleGoal-v1")
    policy.equip(PolicyContext(CONFIG, "a task", PERIOD, 0.3, {}, 10.0, slice(0, len(ANGLES))))
    policy.reset()
    return policy


def goal_seen(
    ahead: float, left: float, walls: tuple[tuple[float, float], ...] = (), moving: float = 0.0
) -> DecodedObservation:
    """What a robot sees of a goal at (ahead, left) [m] between walls: (normal, distance)."""
    ranges = np.full(len(ANGLES), CONFIG.lidar.max_range)
    for normal, distance in walls:
        towards = np.cos(ANGLES - normal)
        offset = distance - CONFIG.lidar_x_offset * math.cos(normal)
        with np.errstate(divide="ignore"):
            ranges = np.where(towards > 1e-6, np.minimum(ranges, offset / towards), ranges)
    distance, bearing = math.hypot(ahead, left), math.atan2(left, ahead)
    return DecodedObservation(
        linear=moving, angular=0.0, distance=distance, bearing=bearing, ranges=ranges
    )


def path_seen(
    points: Floats, cross_track: float = 0.0, heading_error: float = 0.0
) -> DecodedObservation:
    """What a robot at 0.5 m/s sees of a path whose points ahead are (4, 2) [m]."""
    return DecodedObservation(
        linear=0.5,
        angular=0.0,
        cross_track=cross_track,
        heading_error=heading_error,
        remaining=3.0,
        points=points,
    )
