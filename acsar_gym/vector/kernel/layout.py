"""Where a batch keeps its numbers: robots are columns of one float64 array, these are its rows.

Loops over robots thus run over contiguous memory, and vectorise.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.dynamics import Physics
from acsar_gym.jit import jit
from acsar_gym.safety.rules import Rules

Floats = NDArray[np.float64]

# Rows of the state. The body, in the odometry frame:
X, Y, THETA, VX, VY, RATE = range(6)
WHEEL, POINT, ANGLE = 6, 10, 14  # four each: speeds, set points, angles
# The commands: targets of the right and left side, before and after the newest line.
OLD_RIGHT, OLD_LEFT, NEW_RIGHT, NEW_LEFT, HEARD = range(18, 23)
# What the driver knows:
LOOPS, LAST_LINE, AGE, READ = 23, 24, 25, 26  # four readings
ODOM_X, ODOM_Y, ODOM_THETA, LINEAR, ANGULAR = range(30, 35)
# The episode:
GOAL_X, GOAL_Y, LAST_LINEAR, LAST_ANGULAR, STEPS, RETURN, OUTCOME = range(35, 42)
CONTACT, WORLD, START_X, START_Y, START_THETA, START_COS, START_SIN = range(42, 49)
SCANS, SCAN_TICK = 49, 50
# The safety layer: the twists sent last and before that, and why they aren't those asked for.
SENT_LINEAR, SENT_ANGULAR, REASON, PAST_LINEAR, PAST_ANGULAR, LATCHED = range(51, 57)
NEW_LINEAR, NEW_ANGULAR = 57, 58
# What is only told:
TRUE_THETA, TRUE_DISTANCE, ERROR, SUCCESS, SCAN_AGE, STALE = range(59, 65)
GOAL_GIVEN = 65
"""Whether this episode's goal was given, so that the world's path doesn't lead there."""
# Where lines may be lost or late: the episode's key; the newest command that the wire has let
# through or lost, and when; when it let the newest feedback through; when the board's UART is free
# [s]; up to which tick the board has heard, and in which loop for the last time; what went wrong.
KEY, LAST_COMMAND, COMMAND_RELEASE, FEEDBACK_RELEASE, BOARD_FREE = range(66, 71)
HEARD_TICK, HEARD_LOOP, SILENT, FAULT = range(71, 75)
# How long this episode's commands and feedback are on their way, in loops of the firmware:
COMMAND_LOOPS, DELAY_LOOPS = 75, 76
# What options of a reset ask for, in this and all later episodes; zero where they don't. A world is
# its place from 1 on; worlds of a range of difficulty have ranks from FIRST_RANK up to LAST_RANK.
WISHED_WORLD, WISHED_GOAL, WISHED_X, WISHED_Y, FIRST_RANK, LAST_RANK = range(77, 83)
PHYSICS = 83
"""The first of the rows for the numbers of the robot's own `Physics`, drawn for the episode."""
BLEND = PHYSICS + Physics._fields.index("blend_a")  # four each
GAIN = PHYSICS + Physics._fields.index("gain_a")
FEEDBACK_LOOPS = PHYSICS + Physics._fields.index("feedback_loops")
ROWS = PHYSICS + len(Physics._fields)
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
    "true_goal_distance": TRUE_DISTANCE,
    "odometry_error": ERROR,
}
"""Rows of info that every task has."""
WORLD_INFO = {"world": WORLD}
FAULT_INFO = {"fault": FAULT}
SCAN_INFO = {"scan_age": SCAN_AGE, "scan_stale": STALE}
BLOCK = 128
"""Robots that go through a whole env step together, so that their state stays in the cache."""


TURN = 2.0 * math.pi


class LineFaults(NamedTuple):
    """Lines between drivers and boards that are lost or late; see `links.faults.Faults`."""

    possible: bool
    """Whether anything can go wrong at all."""
    episodes: float
    feedback: bool
    """Whether feedback suffers."""
    commands: bool
    """Whether commands suffer."""
    dropped: float
    late: float
    lateness: float
    patience: float
    """Ticks that a reset waits for the wheels to stand."""
    line_time: float
    """Of a command on the wire [s]."""
    processing_time: float
    """[s]"""
    command_timeout: float
    """After which a board that hears nothing stops its motors [s]."""


class Setup(NamedTuple):
    """What all robots of a batch share."""

    dt: float
    period: float
    wire_loops: float
    """Loops of the firmware that a line takes until it is used."""
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
    """Whether commands change from tick to tick: there are limits, a geofence, or faults."""
    rules: Rules
    """Of the safety layer."""
    faults: LineFaults
    falls_silent: bool
    """Whether feedback may stay away for so long that the episode ends."""
    lidar_rate: float
    """Scans per second; 0 where the task has no LiDAR [Hz]."""
    stale: float
    """Age of a stale scan [s]."""
    noise: float
    dropouts: float
    min_range: float
    draws: int
    """Numbers that the noise of a scan takes."""
    numbers: int
    """Of an observation that are the task's own; those of the sensors follow, the LiDAR first."""


class Spawns(NamedTuple):
    """Where episodes begin, and where they lead."""

    min_distance: float
    max_distance: float
    """Of goals drawn on an open floor, where there are no worlds [m]."""
    starts: Floats
    """W x 4: x, y, radius [m] and theta [rad], NaN for any."""
    goals: Floats
    """W x 3: x, y, radius [m]."""
    lengths: Floats
    """W: lengths of the worlds' paths [m]."""
    paths: Floats
    """W x N x 3: samples of the paths to follow, in the odometry frame; no worlds otherwise."""
    samples: NDArray[np.int64]
    """W: samples of each path."""
    order: NDArray[np.int64]
    """W: the worlds from the easiest to the hardest."""


class Tables(NamedTuple):
    """All arrays that change, of a batch of R robots."""

    state: Floats
    """ROWS x columns: at least R, see above."""
    counts: Floats
    """loops x 4 x columns: a ring of encoder counts."""
    commands: Floats
    """ticks x 2 x columns: a ring of command lines; empty where nothing limits commands."""
    arrivals: Floats
    """ticks x 3 x columns: in which loop the boards hear what the wire let through in a tick, and
    its two speeds; empty where no lines are lost or late."""
    random: NDArray[np.uint64]
    """R x 4: generators, see `pcg`."""
    nominal: Floats
    """The configured robot's `Physics`."""
    low: Floats
    high: Floats
    """Least and largest of each number that an episode draws: `randomization.Drawn`."""
    drawn: Floats
    """numbers x columns: what the episodes have drawn; empty where nothing varies."""
    actions: Floats
    """R x 2"""
    over: NDArray[np.bool_]
    """R: whether the robot begins a new episode in this step."""
    idle: NDArray[np.bool_]
    """R: whether it drives no more in this step: it begins anew, or its board is silent."""
    kept: Floats
    """The state of the episode before the step, where boards may fall silent."""
    kept_rays: NDArray[np.float32]
    """R x rays: the observed ranges before the step, where boards fall silent."""
    ranges: Floats
    """R x rays: the LiDAR's newest scan [m]."""
    observations: NDArray[np.float32]
    """R x numbers."""
    rewards: Floats
    """R"""
    ends: NDArray[np.bool_]
    """2 x R: terminated, truncated."""
    ring: NDArray[np.int64]
    """4: where the last loop of the last step wrote its counts, and the last tick its command line;
    the ticks of a step that the next call drives, from and up to."""


class TaskSetup(NamedTuple):
    """What the task's loops need of `Setup`: fewer numbers to unpack in every call."""

    numbers: int
    ticks: int
    period: float
    max_linear: float
    max_angular: float
    max_steps: float
    lidar_rate: float
    stale: float


class TaskTables(NamedTuple):
    """What the task's loops need of `Tables`."""

    state: Floats
    over: NDArray[np.bool_]
    idle: NDArray[np.bool_]
    ranges: Floats
    observations: NDArray[np.float32]
    rewards: Floats
    ends: NDArray[np.bool_]


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
