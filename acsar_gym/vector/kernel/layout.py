"""The arrays of a batch: the rows of its state, and the named tuples that compiled loops take.

Robots are columns of one float64 array and their numbers are its rows, so that loops over robots
run over contiguous memory and can be vectorized.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit
from acsar_gym.physics import Physics
from acsar_gym.sensors.scan import Rays

Floats = NDArray[np.float64]

_NUMBERS = itertools.count()


def _rows(count: int, width: int = 1) -> list[int]:
    """The next rows of the state for `count` names, each with `width` rows; the first of each."""
    return list(itertools.islice(_NUMBERS, count * width))[::width]


# Rows of the state. The body, in the odometry frame:
X, Y, THETA, VX, VY, RATE = _rows(6)
WHEEL, POINT, ANGLE = _rows(3, width=4)  # speeds, set points, angles
# The commands: targets of the right and left side, before and after the newest line.
OLD_RIGHT, OLD_LEFT, NEW_RIGHT, NEW_LEFT, HEARD = _rows(5)
# What the driver knows:
LOOPS, LAST_LINE, AGE = _rows(3)
(READ,) = _rows(1, width=4)  # wheel speeds [rad/s]
ODOM_X, ODOM_Y, ODOM_THETA, LINEAR, ANGULAR = _rows(5)
# The episode:
GOAL_X, GOAL_Y, LAST_LINEAR, LAST_ANGULAR, STEPS, RETURN, OUTCOME = _rows(7)
CONTACT, WORLD, START_X, START_Y, START_THETA, START_COS, START_SIN = _rows(7)
# The LiDAR: phase of its revolution when the episode began, key of its errors, when the newest
# scan's revolution ended [s]:
SCAN_PHASE, SCAN_KEY, SCAN_STAMP, SCAN_START = _rows(4)
# The safety layer: the last two twists sent, and why they differ from those asked for.
SENT_LINEAR, SENT_ANGULAR, REASON, PAST_LINEAR, PAST_ANGULAR, LATCHED = _rows(6)
NEW_LINEAR, NEW_ANGULAR = _rows(2)
# Numbers that only info uses:
TRUE_THETA, TRUE_DISTANCE, ERROR, SUCCESS, SCAN_AGE, STALE = _rows(6)
(GOAL_GIVEN,) = _rows(1)
"""Whether this episode's goal was given as an option, so that the world's path doesn't lead to
it."""
# Where lines may be lost or late: the episode's key; the newest command that the wire has passed on
# or lost, and when [s]; when it passed on the newest feedback [s]; when the board's UART is free
# [s]; up to which tick the board has taken over commands, and in which loop it got the last one;
# whether the board is silent; the fault code of info.
KEY, LAST_COMMAND, COMMAND_RELEASE, FEEDBACK_RELEASE, BOARD_FREE = _rows(5)
HEARD_TICK, HEARD_LOOP, SILENT, FAULT = _rows(4)
# Above, an episode begins with zeros. How long this episode's commands and feedback are on their
# way, in loops of the firmware:
COMMAND_LOOPS, DELAY_LOOPS = _rows(2)
# Options of a reset, for this and all later episodes; zero where there are none. WISHED_WORLD is an
# index from 1; worlds of a range of difficulty have ranks from FIRST_RANK up to LAST_RANK.
WISHED_WORLD, WISHED_GOAL, WISHED_X, WISHED_Y, FIRST_RANK, LAST_RANK = _rows(6)
(PHYSICS,) = _rows(1, width=len(Physics._fields))
"""The first of the rows with the numbers of the robot's `Physics`, drawn for the episode."""
BLEND = PHYSICS + Physics._fields.index("blend_a")  # four each
LEFT_RADIUS = PHYSICS + Physics._fields.index("left_radius")
RIGHT_RADIUS = PHYSICS + Physics._fields.index("right_radius")
HALF_WHEELBASE = PHYSICS + Physics._fields.index("half_wheelbase")
HALF_TRACK = PHYSICS + Physics._fields.index("half_track")
MASS = PHYSICS + Physics._fields.index("mass")
YAW_INERTIA = PHYSICS + Physics._fields.index("yaw_inertia")
GRIP = PHYSICS + Physics._fields.index("grip")
KAPPA = PHYSICS + Physics._fields.index("kappa")
SLIP_SPEED = PHYSICS + Physics._fields.index("slip_speed")
MOTOR_GAIN = PHYSICS + Physics._fields.index("gain_a")
MOTOR_DEADBAND = PHYSICS + Physics._fields.index("deadband_a")
LATENCY_LOOPS = PHYSICS + Physics._fields.index("latency_loops")
COMMAND_DELAY = PHYSICS + Physics._fields.index("command_delay")
FEEDBACK_LOOPS = PHYSICS + Physics._fields.index("feedback_loops")
SCAN_RATE = PHYSICS + Physics._fields.index("scan_rate")
ROWS = next(_NUMBERS)
INFO_ROWS = {
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
ROBOTS_PER_BLOCK = 128
"""Robots that go through a whole env step together, so that their state stays in the cache."""


TURN = 2.0 * math.pi


class LineFaults(NamedTuple):
    """Faults of the lines between drivers and boards; see `links.faults.Faults`."""

    possible: bool
    """Whether any fault can occur."""
    episodes: float
    """Share of episodes that have faults."""
    feedback: bool
    """Whether feedback lines have faults."""
    commands: bool
    """Whether command lines have faults."""
    dropped: float
    """Share of lines that are lost."""
    late: float
    """Share of lines that are late."""
    lateness: float
    """How much later they are [s]."""
    patience: float
    """Ticks that a reset waits for the wheels to stand, at most."""
    line_time: float
    """Duration of a command line on the wire [s]."""
    processing_time: float
    """From the last byte of a command to its use by the board [s]."""
    command_timeout: float
    """A board that gets no command for so long stops its motors [s]."""


class Ramps(NamedTuple):
    """A number for each wheel, in the order of the wheels."""

    a: float
    b: float
    c: float
    d: float


Records = Any
"""A record of Setup, see `jit.record_of`: named tuples of so many numbers take long to compile."""


class Setup(NamedTuple):
    """Numbers that all robots of a batch share."""

    dt: float
    """Duration of a firmware loop, which is also the physics' step [s]."""
    period: float
    """Duration of a tick, the control period [s]."""
    wire_time: float
    """Time from writing a line to its use, without further delays [s]."""
    ramps: Ramps
    """Most that the set points of the four wheels change in a firmware loop [rad/s]."""
    isotropic: bool
    """Whether the tyres of all robots have equal friction in all directions."""
    top: float
    """Top speed of a motor [rad/s]."""
    counts_per_radian: float
    """Encoder counts per angle of a wheel [1/rad]."""
    speed_per_count: float
    """Wheel speed for one count within the encoders' window [rad/s]."""
    quantum: float
    """Printed speeds are rounded to multiples of this [rad/s]; 0 where they aren't."""
    window: int
    """Firmware loops over which the encoders average."""
    ticks: int
    """Control periods in an env step."""
    loops: int
    """Firmware loops in a control period."""
    left_radius: float
    """The radius of the left wheels that the odometry assumes [m]."""
    right_radius: float
    """The radius of the right wheels that the odometry assumes [m]."""
    separation: float
    """The effective wheel separation that the odometry assumes [m]."""
    max_linear: float
    """Linear velocity of a full action [m/s]."""
    max_angular: float
    """Angular velocity of a full action [rad/s]."""
    max_steps: float
    """Time limit of an episode [env steps]; infinite for none."""
    guarded: bool
    """Whether commands must be kept tick by tick: there are limits, a geofence, faults, or commands
    that take longer than a step."""
    faults: LineFaults
    """Faults of the lines."""
    falls_silent: bool
    """Whether feedback may stay away for so long that the episode ends."""
    sees: bool
    """Whether the robots have a LiDAR."""
    stale: float
    """Age from which a scan counts as stale [s]."""
    rays: Rays
    """Of the LiDAR."""
    numbers: int
    """Numbers of an observation that are the task's own; those of the sensors follow, the LiDAR
    first."""


class Spawns(NamedTuple):
    """Starts, goals and paths of the worlds; the goal distances for an open floor."""

    min_distance: float
    """Nearest goal on an open floor [m]."""
    max_distance: float
    """Farthest goal on an open floor [m]."""
    starts: Floats
    """(worlds, 4): x, y, radius [m] and theta [rad], NaN for any direction."""
    goals: Floats
    """(worlds, 3): x, y, radius [m]."""
    lengths: Floats
    """(worlds,): lengths of the worlds' paths [m]."""
    paths: Floats
    """(worlds, samples, 3): the paths to follow, x [m], y [m], direction [rad], in the odometry
    frame; one world without samples where the task follows none."""
    samples: NDArray[np.int64]
    """(worlds,): number of samples of each path."""
    order: NDArray[np.int64]
    """(worlds,): indices of the worlds from the easiest to the hardest."""


class Tables(NamedTuple):
    """All arrays of a batch of R robots that change. Columns are at least R."""

    state: Floats
    """(ROWS, columns)."""
    counts: Floats
    """(firmware loops, 4, columns): a ring of encoder counts."""
    commands: Floats
    """(ticks, 2, columns): a ring of command lines, wheel speeds right and left [rad/s]; no
    columns where nothing limits commands."""
    arrivals: Floats
    """(ticks, 3, columns): the firmware loop in which the boards get what the wire passed on in
    a tick, and its two wheel speeds; no columns where no lines are lost or late."""
    random: NDArray[np.uint64]
    """(R, 4): generators, see `pcg`."""
    nominal: NDArray[Any]
    """The configured robot's, a record of `Physics`."""
    low: Floats
    """Least value of each randomized number: `randomization.Drawn`."""
    high: Floats
    """Largest value of each randomized number."""
    delays: Floats
    """What randomized delays of commands are drawn from [s]."""
    drawn: Floats
    """(numbers, columns): what the episodes have drawn; no rows where nothing varies."""
    actions: Floats
    """(R, 2): linear and angular, as given to the step."""
    over: NDArray[np.bool_]
    """(R,): whether the robot begins a new episode in this step or reset."""
    idle: NDArray[np.bool_]
    """(R,): whether the robot doesn't drive: it begins anew, its board is silent, or this is a
    reset."""
    kept: Floats
    """(COMMAND_LOOPS, columns): the state before the step; no columns where boards can't fall
    silent."""
    kept_rays: NDArray[np.float32]
    """(R, rays): the observed ranges before the step; no rows where boards can't fall silent."""
    ranges: Floats
    """(R, rays): the LiDAR's newest scan [m]."""
    trails: Floats
    """(2, R, slots, 4): where the robots were in the last ticks, by odometry and in truth, as
    `Trail.rows`; no slots without a LiDAR."""
    edges: Floats
    """(rays,): distance from the LiDAR to the edge of the footprint along each ray [m]."""
    observations: NDArray[np.float32]
    """(R, numbers)."""
    rewards: Floats
    """(R,)."""
    ends: NDArray[np.bool_]
    """(2, R): terminated, truncated."""
    ring: NDArray[np.int64]
    """(4,): the slot of `counts` that the last loop of the last step wrote, the slot of
    `commands` that its last tick wrote, and the first tick (and the one after the last) of a
    step that the next call drives."""


class TaskTables(NamedTuple):
    """The fields of `Tables` that the task's loops need."""

    state: Floats
    over: NDArray[np.bool_]
    idle: NDArray[np.bool_]
    ranges: Floats
    edges: Floats
    observations: NDArray[np.float32]
    rewards: Floats
    ends: NDArray[np.bool_]


@jit
def row(state: Floats, number: int, first: int, last: int) -> Floats:
    """View of one number of robots first to last; contiguous."""
    return state[number, first:last]


@jit
def to_world(state: Floats, i: int, x: float, y: float) -> tuple[float, float]:
    """Transform a point of robot i's odometry frame into the frame of its world [m]."""
    cos, sin = state[START_COS, i], state[START_SIN, i]
    return (
        state[START_X, i] + cos * x - sin * y,
        state[START_Y, i] + sin * x + cos * y,
    )
