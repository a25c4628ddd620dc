"""Where a batch keeps its numbers: robots are columns of one float64 array, these are its rows.

Loops over robots thus run over contiguous memory, and vectorise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit
from acsar_gym.safety.limiter import Limits

Floats = NDArray[np.float64]

# Rows of the state. The body, in the odometry frame:
X, Y, THETA, VX, VY, RATE = range(6)
WHEEL, POINT, ANGLE = 6, 10, 14  # four each: speeds, set points, angles
# The commands: targets of the right and left side, before and after the newest line.
OLD_RIGHT, OLD_LEFT, NEW_RIGHT, NEW_LEFT, HEARD = range(18, 23)
# What the driver knows:
LOOPS, LAST_LINE, AGE, READ = 23, 24, 25, 26  # four readings
ODOM_X, ODOM_Y, ODOM_THETA, LINEAR, ANGULAR = range(30, 35)
# The task and the episode:
GOAL_X, GOAL_Y, DISTANCE, LAST_LINEAR, LAST_ANGULAR, STEPS, RETURN, OUTCOME = range(35, 43)
CONTACT, WORLD, START_X, START_Y, START_THETA, START_COS, START_SIN = range(43, 50)
SCANS, SCAN_TICK = 50, 51
PROGRESS, CROSS, BEARING, CROSS_SUM, HEADING_SUM = range(52, 57)
# The safety layer: the twists sent last and before that, and why they aren't those asked for.
SENT_LINEAR, SENT_ANGULAR, REASON, PAST_LINEAR, PAST_ANGULAR, FENCED = range(57, 63)
NEW_LINEAR, NEW_ANGULAR = 63, 64
# What is only told:
TRUE_THETA, TRUE_DISTANCE, ERROR, SUCCESS, SCAN_AGE, STALE = range(65, 71)
HEADING, SHARE, MEAN_CROSS, MEAN_HEADING, SCORE = 71, 72, 73, 74, 75  # four scores
# The robot's own physics, drawn anew with every episode where it is randomized:
MASS, INERTIA, GRIP, RADIUS, DEADBAND, BLEND, GAIN = 79, 80, 81, 82, 83, 84, 88
COMMAND_LOOPS, DELAY_LOOPS, FEEDBACK_LOOPS, DROPPED = range(92, 96)
# What options of a reset ask for, in this and all later episodes; zero where they don't. A world is
# its place from 1 on; worlds of a range of difficulty have ranks from FIRST_RANK up to LAST_RANK.
WISHED_WORLD, WISHED_GOAL, WISHED_X, WISHED_Y, FIRST_RANK, LAST_RANK = range(96, 102)
GOAL_GIVEN = 102
"""Whether this episode's goal was given, so that the world's path doesn't lead there."""
ROWS = 103
INFO = {
    "is_success": SUCCESS,
    "odom_x": ODOM_X,
    "odom_y": ODOM_Y,
    "odom_theta": ODOM_THETA,
    "feedback_age": AGE,
    "sent_linear": SENT_LINEAR,
    "sent_angular": SENT_ANGULAR,
    "sent_reason": REASON,
    "true_x": X,
    "true_y": Y,
    "true_theta": TRUE_THETA,
    "true_contact": CONTACT,
    "odometry_error": ERROR,
}
"""Rows of info that every task has."""
GOAL_INFO = {"goal_distance": DISTANCE, "true_goal_distance": TRUE_DISTANCE}
PATH_INFO = {
    "cross_track_error": CROSS,
    "heading_error": HEADING,
    "path_progress": SHARE,
    "mean_cross_track_error": MEAN_CROSS,
    "mean_heading_error": MEAN_HEADING,
}
WORLD_INFO = {"world": WORLD}
SCAN_INFO = {"scan_age": SCAN_AGE, "scan_stale": STALE}
BLOCK = 128
"""Robots that go through a whole env step together, so that their state stays in the cache."""


TURN = 2.0 * math.pi


class Setup(NamedTuple):
    """What all robots of a batch share."""

    dt: float
    period: float
    half_wheelbase: float
    half_track: float
    slip_speed: float
    ramp: float
    top: float
    counts_per_radian: float
    speed_per_count: float
    window: int
    """Loops over which the encoders average."""
    ticks: int
    """Control periods in an env step."""
    loops: int
    """Firmware loops in a control period."""
    radius: float
    """What the odometry takes the wheel radius for."""
    separation: float
    max_wheel_speed: float
    max_linear: float
    max_angular: float
    max_steps: float
    guarded: bool
    """Whether commands change from tick to tick: there are limits, or a geofence."""
    linear: Limits
    angular: Limits
    fenced: bool
    """Whether there is a geofence."""
    fence: tuple[float, float, float, float]
    """Least and largest x, least and largest y [m]."""
    lidar_rate: float
    """Scans per second; 0 where the task has no LiDAR [Hz]."""
    stale: float
    """Age of a stale scan [s]."""
    noise: float
    dropouts: float
    min_range: float
    draws: int
    """Numbers that the noise of a scan takes."""


class Job(NamedTuple):
    """The task's figures, and the worlds it takes place in."""

    follows: bool
    """A path, instead of driving to a goal."""
    scored: bool
    """By the rules of BARN."""
    min_distance: float
    max_distance: float
    """Of goals drawn on an open floor, where there are no worlds [m]."""
    scale: float
    tolerance: float
    boundary: float
    end: float
    max_cross_track: float
    starts: Floats
    """W x 4: x, y, radius [m] and theta [rad], NaN for any."""
    goals: Floats
    """W x 3: x, y, radius [m]."""
    lengths: Floats
    """W: lengths of the worlds' paths [m]."""
    paths: Floats
    """W x N x 3: samples of the paths to follow."""
    lasts: NDArray[np.int64]
    """W: number of the last sample of each path."""
    order: NDArray[np.int64]
    """W: the worlds from the easiest to the hardest."""


@jit
def row(state: Floats, number: int, first: int, last: int) -> Floats:
    """One number of robots first to last, contiguous."""
    return state[number, first:last]


@jit
def to_world(state: Floats, i: int, x: float, y: float) -> tuple[float, float]:
    """A point of robot i's odometry frame in the frame of its world."""
    cos, sin = state[START_COS, i], state[START_SIN, i]
    return (
        state[START_X, i] + cos * x - sin * y,
        state[START_Y, i] + sin * x + cos * y,
    )
