"""A sensor of moving objects: tracks of the map, and courses on which a robot would meet them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.jit import loop, subroutine
from acsar_gym.links.base import Link
from acsar_gym.sensors.map.courses import COURSES, MOST_GAP, measure_courses
from acsar_gym.sensors.map.seen import Pose, length_of
from acsar_gym.sensors.map.sensor import FARTHEST_CLEARANCE, clip, log_share
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
from acsar_gym.sensors.sensor import MAP, MOVERS, Floats, Sensor, SensorInput
from acsar_gym.trigonometry import cos_sin

MOST_MOVERS = 6
"""Observed tracks, those that the robot could meet first."""
MOST_SPEED = 4.0
"""Larger speeds count as this, in the robot's top speed."""
MOST_RADIUS = 4.0
"""Larger radii count as this, in radii of the robot's footprint."""
NUMBERS = ("known", "x", "y", "speed_x", "speed_y", "radius", "moves", "doubt")
MOVER_NAMES = (
    *(f"mover_{name}_{n}" for n in range(MOST_MOVERS) for name in NUMBERS),
    *(f"contact_{n}" for n in range(len(COURSES))),
    *(f"gap_{n}" for n in range(len(COURSES))),
)
"""The numbers that the sensor adds to the observation: of each track, in the order in which the
robot could meet them, all 0 if there are fewer tracks, then of each of the `courses`. Places and
velocities are in the base frame. (x, y) points at the object, and its length is that of
`log_share`. `known` grows to 1 in KNOWN_SCANS. `moves` is 1 if it surely moves, and a half if it
has moved and stands. `doubt` is the standard deviation of its speed across the ray to it [m/s]."""
FIRST_COURSE = MOST_MOVERS * len(NUMBERS)
MOVER_LOW = np.array(
    [
        -1.0 if name.startswith(("mover_x", "mover_y", "mover_speed")) else 0.0
        for name in MOVER_NAMES
    ]
)
LEAST_AGE = 2
"""A track is observed once this many scans have matched it."""
KNOWN_SCANS = 10
"""A track that this many scans have matched is well known."""
LEAST_CLOSING = 0.1
"""A robot and an object approach each other by at least this in the worst case [m/s]."""
COURSE_SPEED = 0.2
"""An object that doesn't surely move is met on courses if it is faster than this [m/s], and than
COURSE_DEVIATIONS standard deviations of its speed."""
COURSE_DEVIATIONS = 1.5
SCANS, STATE, DOUBT, MEETING = range(RADIUS + 1, RADIUS + 5)
"""Columns of a listed track, after the first columns of tracks, in the base frame: age [scans],
number for `moves`, standard deviation of its speed [m/s], and when the robot could meet it at the
earliest [s]."""


@subroutine
def list_tracks(record: Any, pose: Pose) -> Floats:
    """List all tracks that are observed, in the base frame."""
    rows = np.empty((MOST_TRACKS, MEETING + 1))
    cos, sin = cos_sin(pose[2])
    count = 0
    for k in range(MOST_TRACKS):
        track = record.tracks[k]
        if track[AGE] < LEAST_AGE:
            continue

        # From the odometry frame into the robot's.
        row = rows[count]
        dx = track[X] - pose[0]
        dy = track[Y] - pose[1]
        row[X] = dx * cos + dy * sin
        row[Y] = dy * cos - dx * sin
        row[VX] = track[VX] * cos + track[VY] * sin
        row[VY] = track[VY] * cos - track[VX] * sin
        row[RADIUS] = track[RADIUS]
        row[SCANS] = track[AGE]
        row[STATE] = 0.5 * (track[MOVES] + track[HAS_MOVED])
        row[DOUBT] = math.sqrt(track[SPEED_VAR])

        # At the earliest the robot meets it if it drives straight towards it at top speed.
        distance = length_of(dx, dy)
        closing = record.top_speed - (row[X] * row[VX] + row[Y] * row[VY]) / max(distance, 1e-9)
        gap = max(distance - track[RADIUS] - record.radius, 0.0)
        row[MEETING] = gap / max(closing, LEAST_CLOSING)
        count += 1
    return rows[:count]


@subroutine
def fill_movers(record: Any, pose: Pose, out: Floats) -> None:
    """Fill in the numbers that the movers add to the observation.

    Args:
        record: `RECORD` of the robot, with its newest scan.
        pose: The robot's pose by odometry.
        out: (len(MOVER_NAMES),): Gets the numbers.
    """
    listed = list_tracks(record, pose)
    out[:] = 0.0

    # Courses meet those that surely move or are fast.
    met = np.empty((MOST_TRACKS, RADIUS + 1))
    count = 0
    for k in range(len(listed)):
        row = listed[k]
        speed = length_of(row[VX], row[VY])
        if row[STATE] == 1.0 or speed > max(COURSE_SPEED, COURSE_DEVIATIONS * row[DOUBT]):
            met[count] = row[: RADIUS + 1]
            count += 1
    measure_courses(record.courses, record.radius, met[:count], out=out[FIRST_COURSE:])
    for n in range(FIRST_COURSE + len(COURSES), len(MOVER_NAMES)):
        out[n] = log_share(out[n], MOST_GAP)

    # The tracks that the robot could meet first.
    scale = 1.0 / (MOST_SPEED * record.top_speed)
    for n in range(min(MOST_MOVERS, len(listed))):
        row = listed[listed[:, MEETING].argmin()]
        distance = length_of(row[X], row[Y])
        share = log_share(distance / record.radius, FARTHEST_CLEARANCE) / max(distance, 1e-9)
        numbers = (
            min(row[SCANS] / KNOWN_SCANS, 1.0),
            row[X] * share,
            row[Y] * share,
            clip(row[VX] * scale, 1.0),
            clip(row[VY] * scale, 1.0),
            clip(row[RADIUS] / (MOST_RADIUS * record.radius), 1.0),
            row[STATE],
            clip(row[DOUBT], 1.0),
        )
        for k in range(len(NUMBERS)):
            out[n * len(NUMBERS) + k] = numbers[k]
        row[MEETING] = math.inf  # so that the next search finds another track


@loop
def fill_alone(records: Any, pose: Pose, out: Floats) -> None:
    """`fill_movers` for the robot of a single environment."""
    fill_movers(records[0], pose, out)


class MoversSensor(Sensor):
    """Adds the places and velocities of the nearest movers, see `MOVER_NAMES`.

    It needs a map and a LiDAR among the robot's sensors.

    Args:
        link: Link of the robot.
        config: Robot configuration.
    """

    name = MOVERS
    size = len(MOVER_NAMES)
    low = MOVER_LOW
    high = 1.0
    needs = (MAP,)

    def __init__(self, link: Link | None, config: RobotConfig) -> None:
        self.config = config

    def read(self, robots: SensorInput, out: Floats) -> None:
        """Fill in the numbers that `MOVER_NAMES` names, (1, size)."""
        map_sensor: Any = self.needed[MAP]
        fill_alone(map_sensor.records, map_sensor.pose, out[0])
