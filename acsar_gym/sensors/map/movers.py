"""What moves around a robot, as a sensor: the nearest of the map's tracks."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.jit import loop, subroutine
from acsar_gym.links.base import Link
from acsar_gym.odometry import Odometry
from acsar_gym.sensors.map.sensor import FARTHEST_CLEARANCE, MapSensor, log_share
from acsar_gym.sensors.map.tracks import AGE, MOST_TRACKS, MOVES, RADIUS, VX, VY, X, Y
from acsar_gym.sensors.sensor import MOVERS, Floats, Sensor
from acsar_gym.trigonometry import cos_sin
from acsar_gym.truth import GroundTruth

MOST_MOVERS = 6
"""So many of them are observed, the nearest ones."""
MOST_SPEED, MOST_RADIUS = 4.0, 4.0
"""Speeds and radii beyond count as these, in the robot's top speed and radii of its footprint."""
NUMBERS = ("seen", "x", "y", "speed_x", "speed_y", "radius")
MOVER_NAMES = tuple(f"mover_{name}_{n}" for n in range(MOST_MOVERS) for name in NUMBERS)
"""The numbers that the sensor adds to the observation, the nearest mover first; all are 0 where
there is none. Places and velocities are in the base frame. (x, y) points at the mover, and its
length is that of `log_share`."""
MOVER_LOW = np.array([0.0, -1.0, -1.0, -1.0, -1.0, 0.0] * MOST_MOVERS)


@subroutine
def fill_movers(record: Any, pose: tuple[float, float, float], out: Floats) -> None:
    """Fill in what the movers add to the observation, (len(MOVER_NAMES),).

    `record` is the map's, which has been updated; `pose` is the robot's by odometry.
    """
    out[:] = 0.0
    tracks, cos, sin = record.tracks, *cos_sin(pose[2])
    farther_than, count = -1.0, len(NUMBERS)
    for n in range(MOST_MOVERS):
        nearest, best = math.inf, -1
        for k in range(MOST_TRACKS):
            dx, dy = tracks[k, X] - pose[0], tracks[k, Y] - pose[1]
            far = dx * dx + dy * dy
            if tracks[k, AGE] > 0.0 and tracks[k, MOVES] > 0.0 and farther_than < far < nearest:
                nearest, best = far, k
        if best < 0:
            break
        farther_than, track = nearest, tracks[best]
        dx, dy, far = track[X] - pose[0], track[Y] - pose[1], math.sqrt(nearest)
        share = log_share(far / record.radius, FARTHEST_CLEARANCE) / max(far, 1e-9)
        scale = 1.0 / (MOST_SPEED * record.top_speed)
        out[n * count] = 1.0
        out[n * count + 1] = (dx * cos + dy * sin) * share
        out[n * count + 2] = (dy * cos - dx * sin) * share
        out[n * count + 3] = limit((track[VX] * cos + track[VY] * sin) * scale)
        out[n * count + 4] = limit((track[VY] * cos - track[VX] * sin) * scale)
        out[n * count + 5] = limit(track[RADIUS] / (MOST_RADIUS * record.radius))


@subroutine
def limit(value: float) -> float:
    """A value within -1 to 1."""
    return min(max(value, -1.0), 1.0)


@loop
def fill_alone(records: Any, pose: tuple[float, float, float], out: Floats) -> None:
    """`fill_movers` for the robot of a single environment."""
    fill_movers(records[0], pose, out)


class MoversSensor(Sensor):
    """Adds the places and velocities of the nearest movers, see `MOVER_NAMES`.

    It needs a map and a LiDAR among the robot's sensors.
    """

    name, size, low, high = MOVERS, len(MOVER_NAMES), MOVER_LOW, 1.0
    uses_truth = False
    _map: MapSensor
    """Of the robot, see `watch`."""

    def __init__(self, link: Link | None, config: RobotConfig) -> None:
        self.config = config
        self._odometry = Odometry.of(config)

    def watch(self, seen: MapSensor | None) -> None:
        """Take over the map whose tracks are told.

        Args:
            seen: of the robot; None where it has none.

        Raises:
            ConfigError: for None.
        """
        if seen is None:
            raise ConfigError("sensor 'movers': the robot has no 'map', which it needs")
        self._map = seen

    def follow(self, odometry: Odometry) -> None:
        """Take over the robot's odometry."""
        self._odometry = odometry

    def read(self, truth: GroundTruth | None, now: float) -> Floats:
        """Return the numbers that `MOVER_NAMES` names."""
        out = np.zeros(self.size)
        fill_alone(self._map.records, self._odometry.pose, out)
        return out
