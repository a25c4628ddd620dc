"""Where a batch keeps its numbers: robots are columns of one float64 array, these are its rows.

Loops over robots thus run over contiguous memory, and vectorise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.compiled import jit

Floats = NDArray[np.float64]

# Rows of the state. The body, in the world frame:
X, Y, THETA, VX, VY, RATE = range(6)
WHEEL, POINT, ANGLE = 6, 10, 14  # four each: speeds, set points, angles
# The commands: targets of the right and left side, before and after the newest line.
OLD_RIGHT, OLD_LEFT, NEW_RIGHT, NEW_LEFT, HEARD = range(18, 23)
# What the driver knows:
LOOPS, LAST_LINE, AGE, READ = 23, 24, 25, 26  # four readings
ODOM_X, ODOM_Y, ODOM_THETA, LINEAR, ANGULAR = range(30, 35)
# The task and the episode:
GOAL_X, GOAL_Y, DISTANCE, LAST_LINEAR, LAST_ANGULAR, STEPS, RETURN, OUTCOME = range(35, 43)
CONTACT = 43
# The robot's own physics, drawn anew with every episode where it is randomized:
MASS, INERTIA, GRIP, RADIUS, DEADBAND, BLEND, GAIN = 44, 45, 46, 47, 48, 49, 53
COMMAND_LOOPS, DELAY_LOOPS, FEEDBACK_LOOPS, DROPPED = range(57, 61)
ROWS = 61
INFO = (
    "goal_distance",
    "odom_x",
    "odom_y",
    "odom_theta",
    "feedback_age",
    "true_x",
    "true_y",
    "true_theta",
    "true_goal_distance",
    "true_contact",
    "odometry_error",
    "is_success",
)
"""Names of the rows of info."""
KEPT = 5
"""So many of them are in the state as they are."""
NUMBERS = 7
"""Numbers of the observation before the rays."""
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
    min_distance: float
    max_distance: float
    tolerance: float
    boundary: float
    max_steps: float


@jit
def row(state: Floats, number: int, first: int, last: int) -> Floats:
    """One number of robots first to last, contiguous."""
    return state[number, first:last]
