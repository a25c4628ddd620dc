"""The arrays of a batch: records of its robots, and the named tuples that compiled loops take.

The robots of a batch are kept in blocks. A block is one record, and each of its fields an array
over the block's robots: `robots = blocks[block]`, then `robots.goal_x[i]`. So loops over the
robots of a block run over contiguous memory and can be vectorized, which they can't where every
robot is a record of its own.

To add a number of a robot: add a field to `Episode`, to `Build` where its configuration decides, or
to `Robots` where it outlives episodes otherwise. What all robots share is in `Setup`.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import COMPILED, jit
from acsar_gym.physics import Physics
from acsar_gym.safety.rules import AxisLimits, SafetyRules

Floats = NDArray[np.float64]
Number = Annotated[Floats, ()]
"""A number of each robot of a block, (BLOCK_ROBOTS,)."""
WheelNumber = Annotated[Floats, (4,)]
"""A number of each wheel of each robot of a block, (4, BLOCK_ROBOTS), in the order of wheels."""

BLOCK_ROBOTS = 64
"""Robots of a block. They go through a whole env step together, so that they stay in the cache."""
TURN = 2.0 * math.pi


class Episode:
    """Numbers that are zero when an episode begins; flags and codes are numbers, too.

    Where a board falls silent in a step, they become again what they were before it.
    """

    x: Number
    """Position of the body [m], in the odometry frame as the next ones."""
    y: Number
    theta: Number
    """Its heading [rad]."""
    vx: Number
    """Its velocity [m/s]."""
    vy: Number
    rate: Number
    """Its yaw rate [rad/s]."""
    wheel_speed: WheelNumber
    """[rad/s]."""
    set_point: WheelNumber
    """Speeds that the board asks of the motors [rad/s]."""
    wheel_angle: WheelNumber
    """[rad]."""

    target_right: Number
    """Speeds of the right and left wheels that the board aims at [rad/s]."""
    target_left: Number
    new_right: Number
    """Those of the newest command, as the next ones where it is the same in all ticks of a step."""
    new_left: Number
    heard: Number
    """From which firmware loop of a step the board knows the newest command."""

    loops: Number
    """Firmware loops since the reset."""
    last_line: Number
    """Number of the newest feedback line that has arrived."""
    age: Number
    """Of the newest feedback [s]."""
    read_speed: WheelNumber
    """Wheel speeds by the newest feedback [rad/s]."""
    odom_x: Number
    """Pose by odometry [m, m, rad]."""
    odom_y: Number
    odom_theta: Number
    linear: Number
    """Twist by odometry [m/s, rad/s]."""
    angular: Number

    goal_x: Number
    """The goal in the odometry frame [m]."""
    goal_y: Number
    goal_given: Number
    """Whether the goal is a reset's option, so that the world's path doesn't lead to it."""
    action_linear: Number
    """The newest action, -1 to 1."""
    action_angular: Number
    steps: Number
    """Env steps since the reset."""
    total_reward: Number
    outcome: Number
    """See `tasks.base.Outcome`."""
    contact: Number
    """Whether the robot has touched an obstacle."""
    world: Number
    """Index of the world."""
    start_x: Number
    """The start in the frame of the world [m, m, rad], and cosine and sine of its direction."""
    start_y: Number
    start_theta: Number
    start_cos: Number
    start_sin: Number
    scan_start: Number
    """When the LiDAR's clock began: the time of the reset [s]."""
    scan_phase: Number
    """Phase of its revolution at that time, 0 to 1."""
    scan_key: Number
    """Key of its errors, 0 to 1."""
    scan_stamp: Number
    """When the newest scan's revolution ended [s]."""

    sent_linear: Number
    """The newest twist that was sent [m/s, rad/s]."""
    sent_angular: Number
    reason: Number
    """Why it isn't the one asked for, see `safety.rules.Reason`."""
    latched: Number
    """The reason that holds the robot until the reset."""
    new_linear: Number
    """The newest twist by the limits, and the one before it [m/s, rad/s]."""
    new_angular: Number
    past_linear: Number
    past_angular: Number

    true_theta: Number
    """For info alone, as the next ones: the heading within half a turn [rad]."""
    goal_distance: Number
    """[m]."""
    odom_error: Number
    """Distance between the position and that by odometry [m]."""
    success: Number
    work: Number
    """Mechanical work of the motors, where the batch is `metered` [J]."""
    scan_age: Number
    """[s]."""
    scan_stale: Number

    key: Number
    """The episode's, which decides on lost and late lines; negative where none are. This and the
    next ones are used where lines may be lost or late."""
    last_command: Number
    """The newest command that the wire has passed on or lost."""
    command_release: Number
    """When it passed on the newest command [s]."""
    feedback_release: Number
    """When it passed on the newest feedback [s]."""
    board_free: Number
    """When the board's UART is free [s]."""
    heard_tick: Number
    """Up to which tick the board has taken over commands."""
    heard_loop: Number
    """In which firmware loop the board got the newest command."""
    silent: Number
    """Whether the board was silent in the reset."""
    fault: Number
    """The code of info."""


class Options:
    """Options of a reset, for this and all later episodes; zero where there are none."""

    wished_world: Number
    """Index of the world, from 1."""
    wished_goal: Number
    """Whether a goal is asked for."""
    wished_x: Number
    """That goal in the odometry frame [m]."""
    wished_y: Number
    first_rank: Number
    """Worlds of a range of difficulty have ranks from this one up to the next one."""
    last_rank: Number


class Build:
    """What follows from a robot's configuration; written once, when the batch is made."""

    kind: Number
    """Which of the batch's configurations it has: an index into arrays of kinds."""
    ramp: WheelNumber
    """Most that the set points of the four wheels change in a firmware loop [rad/s]."""
    counts_per_radian: Number
    """Encoder counts per angle of a wheel [1/rad]."""
    speed_per_count: Number
    """Wheel speed for one count within the encoders' window [rad/s]."""
    quantum: Number
    """Printed speeds are rounded to multiples of this [rad/s]; 0 where they aren't."""
    max_linear: Number
    """Linear velocity of a full action [m/s]."""
    max_angular: Number
    """Angular velocity of a full action [rad/s]."""
    stale: Number
    """Age from which a scan counts as stale [s]."""
    rays: Number
    """How many rays its LiDAR has."""
    first_world: Number
    """Index of the first world that was made for its footprint."""
    worlds: Number
    """How many there are."""


class Robots(Episode, Options, Build):
    """The robots of a block."""

    command_loops: Number
    """How long this episode's commands are on their way [firmware loops]."""
    feedback_delay: Number
    """How long this episode's feedback is on its way [firmware loops]."""
    physics: Any
    """The fields of `Physics`, drawn for the episode; numbers of wheels as `gain`, (4, robots)."""
    rules: Any
    """The fields of `SafetyRules`, see `rules_of`; those of an axis as `linear_max_velocity`."""


def _fields(kind: type) -> list[tuple[str, Any, tuple[int, ...]]]:
    """Fields of a record for the numbers that a class declares."""
    return [
        (name, np.float64, (*hint.__metadata__[0], BLOCK_ROBOTS))
        for name, hint in inspect.get_annotations(kind, eval_str=True).items()
        if hint is not Any
    ]


def _physics_fields() -> list[tuple[str, Any, tuple[int, ...]]]:
    """Fields of a record for `Physics`: those of four wheels, named _a to _d, are one."""
    found: list[tuple[str, Any, tuple[int, ...]]] = []
    for name in Physics._fields:
        stem, _, wheel = name.rpartition("_")
        if wheel == "a":
            found.append((stem, np.float64, (4, BLOCK_ROBOTS)))
        elif wheel not in tuple("bcd"):
            found.append((name, np.float64, (BLOCK_ROBOTS,)))
    return found


def _rules_fields() -> list[tuple[str, Any, tuple[int, ...]]]:
    """Fields of a record for `SafetyRules`, but for the period, which robots share."""
    names: list[str] = []
    for name in SafetyRules._fields[1:]:
        axis = name in ("linear", "angular")
        names += [f"{name}_{limit}" for limit in AxisLimits._fields] if axis else [name]
    return [(name, np.float64, (BLOCK_ROBOTS,)) for name in names]


BLOCK = np.dtype(
    [
        *_fields(Episode),
        *_fields(Options),
        *_fields(Robots),
        ("physics", _physics_fields()),
        *_fields(Build),
        ("rules", _rules_fields()),
    ]
)
"""The record of a block: `Robots`."""
ROWS = {
    name: range(offset // (8 * BLOCK_ROBOTS), (offset + kind.itemsize) // (8 * BLOCK_ROBOTS))
    for name, (kind, offset, *_) in (BLOCK.fields or {}).items()
}
"""Rows of a field where a block is seen as a matrix of numbers and robots, see `Tables.numbers`."""
EPISODE_ROWS = ROWS[_fields(Episode)[-1][0]].stop
"""How many rows an episode has; they are the first ones."""
OPTIONS = tuple(name for name, *_ in _fields(Options))
PHYSICS_ROW = ROWS["physics"].start
BUILD = tuple(name for name, *_ in _fields(Build))
BUILD_ROW = ROWS[BUILD[0]].start
"""The first row of `Build` and `rules`; they are the last ones."""
INFO_FIELDS = {
    "is_success": "success",
    "odom_x": "odom_x",
    "odom_y": "odom_y",
    "odom_theta": "odom_theta",
    "feedback_age": "age",
    "sent_linear": "sent_linear",
    "sent_angular": "sent_angular",
    "sent_reason": "reason",
    "true_x": "x",
    "true_y": "y",
    "true_theta": "true_theta",
    "true_contact": "contact",
    "true_goal_distance": "goal_distance",
    "odometry_error": "odom_error",
}
"""Keys of info that every task has, and their fields."""


def make_blocks(robots: int) -> NDArray[Any]:
    """Blocks for so many robots, all zero; the last block may have more."""
    blocks = np.zeros(-(-robots // BLOCK_ROBOTS), BLOCK)
    return blocks if COMPILED else blocks.view(np.recarray)


def view_numbers(blocks: NDArray[Any]) -> Floats:
    """The same memory as (blocks, rows, BLOCK_ROBOTS)."""
    return np.asarray(blocks).view(np.float64).reshape(len(blocks), -1, BLOCK_ROBOTS)


def read_fields(numbers: Floats, names: Sequence[str], robots: Any) -> Floats:
    """Copy fields of some robots, (numbers, robots); those of wheels are four numbers.

    Args:
        numbers: of all blocks, see `view_numbers`.
        names: of the fields.
        robots: indices of robots, or a slice.
    """
    rows = [row for name in names for row in ROWS[name]]
    found: Floats = numbers[:, rows].swapaxes(0, 1).reshape(len(rows), -1)[:, robots]
    return found


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
    isotropic: bool
    """Whether the tyres of all robots have equal friction in all directions."""
    window: int
    """Firmware loops over which the encoders average."""
    ticks: int
    """Control periods in an env step."""
    loops: int
    """Firmware loops in a control period."""
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
    numbers: int
    """Numbers of an observation that are the task's own; those of the sensors follow, those of map
    and LiDAR first."""
    maps: bool
    """Whether the robots have a map."""
    first_ray: int
    """Place of the LiDAR's first number in an observation."""
    metered: bool = False
    """Whether the work of the motors is measured."""


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
    """(worlds,): indices of the worlds from the easiest to the hardest, of one footprint's worlds
    after another's."""


class Tables(NamedTuple):
    """All arrays of a batch of R robots that change."""

    blocks: Any
    """(blocks,): records of `Robots`."""
    numbers: Floats
    """(blocks, rows, BLOCK_ROBOTS): the same memory, for what treats many fields alike."""
    counts: Floats
    """(blocks, firmware loops, 4, BLOCK_ROBOTS): a ring of encoder counts."""
    commands: Floats
    """(blocks, ticks, 2, BLOCK_ROBOTS): a ring of command lines, wheel speeds right and left
    [rad/s]; no ticks where nothing limits commands."""
    arrivals: Floats
    """(blocks, ticks, 3, BLOCK_ROBOTS): the firmware loop in which the boards get what the wire
    passed on in a tick, and its two wheel speeds; no ticks where no lines are lost or late."""
    random: NDArray[np.uint64]
    """(R, 4): generators, see `pcg`."""
    nominal: NDArray[Any]
    """(kinds,): records of `Physics`, as configured."""
    low: Floats
    """(kinds, numbers): least value of each randomized number: `randomization.Drawn`."""
    high: Floats
    """(kinds, numbers): largest value of each randomized number."""
    delays: Floats
    """(kinds, delays): what randomized delays of commands are drawn from [s]."""
    delay_counts: NDArray[np.int64]
    """(kinds,): how many of these a kind has."""
    rays: NDArray[Any]
    """(kinds,): records of `Rays`."""
    drawn: Floats
    """(R, numbers): what the episodes have drawn; no numbers where nothing varies."""
    actions: Floats
    """(R, 2): linear and angular, as given to the step."""
    over: NDArray[np.bool_]
    """(R,): whether the robot begins a new episode in this step or reset."""
    idle: NDArray[np.bool_]
    """(R,): whether the robot doesn't drive: it begins anew, its board is silent, or this is a
    reset."""
    kept: Floats
    """(blocks, EPISODE_ROWS, BLOCK_ROBOTS): the episodes before the step; no rows where boards
    can't fall silent."""
    kept_rays: NDArray[np.float32]
    """(R, rays): the observed ranges before the step; no robots where boards can't fall silent."""
    ranges: Floats
    """(R, rays): the LiDAR's newest scan [m]; a robot may have fewer, see `Build.rays`."""
    trails: Floats
    """(2, R, slots, 4): where the robots were in the last ticks, by odometry and in truth, as
    `Trail.rows`; no slots without a LiDAR."""
    maps: NDArray[Any]
    """(R,): `sensors.map.RECORD`; no robots where they have no map."""
    scratch: NDArray[np.int32]
    """(blocks, numbers): for the search of ways; no blocks without a map."""
    edges: Floats
    """(kinds, rays): distance from the LiDAR to the edge of the footprint along each ray [m]."""
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

    blocks: Any
    over: NDArray[np.bool_]
    idle: NDArray[np.bool_]
    ranges: Floats
    edges: Floats
    observations: NDArray[np.float32]
    rewards: Floats
    ends: NDArray[np.bool_]


@jit
def rules_of(robots: Robots, i: int, period: float) -> SafetyRules:
    """The safety rules of robot i; `period` is the setup's."""
    own = robots.rules
    return SafetyRules(
        period,
        own.free[i] > 0.0,
        AxisLimits(
            own.linear_min_velocity[i],
            own.linear_max_velocity[i],
            own.linear_min_acceleration[i],
            own.linear_max_acceleration[i],
            own.linear_min_jerk[i],
            own.linear_max_jerk[i],
            own.linear_min_reverse[i],
            own.linear_max_reverse[i],
        ),
        AxisLimits(
            own.angular_min_velocity[i],
            own.angular_max_velocity[i],
            own.angular_min_acceleration[i],
            own.angular_max_acceleration[i],
            own.angular_min_jerk[i],
            own.angular_max_jerk[i],
            own.angular_min_reverse[i],
            own.angular_max_reverse[i],
        ),
        own.min_x[i],
        own.max_x[i],
        own.min_y[i],
        own.max_y[i],
        own.stale[i],
        own.timeout[i],
        own.left_radius[i],
        own.right_radius[i],
        own.separation[i],
        own.top[i],
    )


@jit
def robots_of_block(block: int, robots: int) -> int:
    """How many of a batch's robots are in a block."""
    left = robots - block * BLOCK_ROBOTS
    return left if left < BLOCK_ROBOTS else BLOCK_ROBOTS


@jit
def to_world(robots: Robots, i: int, x: float, y: float) -> tuple[float, float]:
    """Transform a point of robot i's odometry frame into the frame of its world [m]."""
    cos, sin = robots.start_cos[i], robots.start_sin[i]
    return (
        robots.start_x[i] + cos * x - sin * y,
        robots.start_y[i] + sin * x + cos * y,
    )
