"""What moves around a robot, as a sensor: tracks of the map, and courses that would meet them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.jit import loop, subroutine
from acsar_gym.links.base import Link
from acsar_gym.odometry import Odometry
from acsar_gym.sensors.map.courses import COURSES, MOST_GAP, measure_courses
from acsar_gym.sensors.map.sensor import FARTHEST_CLEARANCE, MapSensor, log_share
from acsar_gym.sensors.map.tracks import (
    AGE,
    HAS_MOVED,
    MOST_TRACKS,
    MOVES,
    RADIUS,
    SPEED_VAR,
    VX,
    VY,
    X,
    Y,
)
from acsar_gym.sensors.sensor import MOVERS, Floats, Sensor
from acsar_gym.trigonometry import cos_sin
from acsar_gym.truth import GroundTruth

MOST_MOVERS = 6
"""So many of them are observed, those that the robot could meet first."""
MOST_SPEED, MOST_RADIUS = 4.0, 4.0
"""Speeds and radii beyond count as these, in the robot's top speed and radii of its footprint."""
NUMBERS = ("known", "x", "y", "speed_x", "speed_y", "radius", "moves", "doubt")
MOVER_NAMES = (
    *(f"mover_{name}_{n}" for n in range(MOST_MOVERS) for name in NUMBERS),
    *(f"contact_{n}" for n in range(len(COURSES))),
    *(f"gap_{n}" for n in range(len(COURSES))),
)
"""The numbers that the sensor adds to the observation: of each track, in the order in which the
robot could meet them, all 0 where there is none, then of each of the `courses`. Places and
velocities are in the base frame. (x, y) points at the mover, and its length is that of
`log_share`. `known` grows to 1 in KNOWN_SCANS; `moves` is 1 where it is sure to move, and a half
where it has moved and stands; `doubt` is the standard deviation of its speed across the ray to
it [m/s]."""
FIRST_COURSE = MOST_MOVERS * len(NUMBERS)
MOVER_LOW = np.array(
    [
        -1.0 if name.startswith(("mover_x", "mover_y", "mover_speed")) else 0.0
        for name in MOVER_NAMES
    ]
)
LEAST_AGE, KNOWN_SCANS = 2, 10
"""A track is observed that so many scans have matched; one that has as many as the second is well
known."""
LEAST_CLOSING = 0.1
"""A robot and somebody else come nearer by at least so much, as far as one can know [m/s]."""
COURSE_SPEED, COURSE_DEVIATIONS = 0.2, 1.5
"""Who moves, or is faster than the first and than so many standard deviations of its speed, may be
met on a course [m/s]."""


@subroutine
def list_tracks(record: Any, pose: tuple[float, float, float], rows: Floats) -> int:
    """List all tracks that are observed in the base frame.

    `rows`, (MOST_TRACKS, 9), gets x, y [m], velocity x, y [m/s], radius [m], age [scans], what
    `moves` tells, the standard deviation of its speed [m/s], and when the robot could meet it at
    the earliest [s].

    Returns:
        How many there are.
    """
    (cos, sin), count = cos_sin(pose[2]), 0
    for k in range(MOST_TRACKS):
        track = record.tracks[k]
        if track[AGE] < LEAST_AGE:
            continue
        row, dx, dy = rows[count], track[X] - pose[0], track[Y] - pose[1]
        row[0], row[1] = dx * cos + dy * sin, dy * cos - dx * sin
        row[2] = track[VX] * cos + track[VY] * sin
        row[3] = track[VY] * cos - track[VX] * sin
        row[4], row[5], row[6] = track[RADIUS], track[AGE], 0.5 * (track[MOVES] + track[HAS_MOVED])
        row[7] = math.sqrt(track[SPEED_VAR])
        far = math.sqrt(dx * dx + dy * dy)
        closing = record.top_speed - (row[0] * row[2] + row[1] * row[3]) / max(far, 1e-9)
        row[8] = max(far - track[RADIUS] - record.radius, 0.0) / max(closing, LEAST_CLOSING)
        count += 1
    return count


@subroutine
def fill_movers(record: Any, pose: tuple[float, float, float], out: Floats) -> None:
    """Fill in what the movers add to the observation, (len(MOVER_NAMES),).

    `record` is the map's, which has been updated; `pose` is the robot's by odometry.
    """
    out[:] = 0.0
    rows, met, quick = np.empty((MOST_TRACKS, 9)), np.empty((MOST_TRACKS, 5)), 0
    listed = rows[: list_tracks(record, pose, rows)]
    scale, width = 1.0 / (MOST_SPEED * record.top_speed), len(NUMBERS)
    for k in range(len(listed)):
        speed = math.sqrt(listed[k, 2] * listed[k, 2] + listed[k, 3] * listed[k, 3])
        least = max(COURSE_SPEED, COURSE_DEVIATIONS * listed[k, 7])
        if listed[k, 6] == 1.0 or speed > least:
            met[quick] = listed[k, :5]
            quick += 1
    measure_courses(record.courses, record.radius, met[:quick], out[FIRST_COURSE:])
    for n in range(FIRST_COURSE + len(COURSES), len(MOVER_NAMES)):
        out[n] = log_share(out[n], MOST_GAP)
    for n in range(min(MOST_MOVERS, len(listed))):
        row = listed[listed[:, 8].argmin()]
        far = math.sqrt(row[0] * row[0] + row[1] * row[1])
        share = log_share(far / record.radius, FARTHEST_CLEARANCE) / max(far, 1e-9)
        place = n * width
        out[place] = min(row[5] / KNOWN_SCANS, 1.0)
        out[place + 1], out[place + 2] = row[0] * share, row[1] * share
        out[place + 3], out[place + 4] = clip_to_one(row[2] * scale), clip_to_one(row[3] * scale)
        out[place + 5] = clip_to_one(row[4] / (MOST_RADIUS * record.radius))
        out[place + 6], out[place + 7] = row[6], clip_to_one(row[7])
        row[8] = math.inf


@subroutine
def clip_to_one(value: float) -> float:
    """Clip a value to -1 to 1."""
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
