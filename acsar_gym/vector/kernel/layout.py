"""The arrays of a batch: records of its robots, and the named tuples that compiled loops take.

The robots of a batch are kept in blocks. A block is one record, and each of its fields is an array
over the block's robots: `robots = blocks[block]`, then `robots.goal_x[i]`. So loops over the
robots of a block run over contiguous memory and can be vectorized, which isn't possible if every
robot is a record of its own.

Fields that info contains have the names of its keys, see `tasks.state`.

To add a number of a robot, add a field to `Episode`, to `Build` if it follows from the robot's
configuration, or to `Robots` if it outlives episodes otherwise. What all robots share is in
`Setup`.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple, get_type_hints

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit
from acsar_gym.physics import Physics
from acsar_gym.safety.rules import AxisLimits, SafetyRules
from acsar_gym.worlds.geometry import Surroundings
from acsar_gym.worlds.movers import Motions

Floats = NDArray[np.float64]
Number = Annotated[Floats, ()]
"""A number of each robot of a block, (BLOCK_ROBOTS,)."""
WheelNumber = Annotated[Floats, (4,)]
"""A number of each wheel of each robot of a block, (4, BLOCK_ROBOTS), in the order of wheels."""
Fields = list[tuple[str, Any, tuple[int, ...]]]
"""Fields of a record: name, type and shape."""

BLOCK_ROBOTS = 64
"""Robots of a block. They go through a whole env step together, so that they stay in the cache."""
TURN = 2.0 * math.pi
RIGHT, LEFT = range(2)
"""Sides of a robot in `Tables.commands`."""
ODOMETRY, TRUTH = range(2)
"""Whose poses are in `Scans.trails`."""


class Episode:
    """Numbers that are zero when an episode starts. Flags and codes are numbers too."""

    true_x: Number  # position of the body [m], in the odometry frame as the next ones
    true_y: Number
    theta: Number  # its heading [rad]
    vx: Number  # its velocity [m/s]
    vy: Number
    rate: Number  # its yaw rate [rad/s]
    wheel_speed: WheelNumber  # [rad/s]
    set_point: WheelNumber  # speeds that the board asks of the motors [rad/s]
    wheel_angle: WheelNumber  # [rad]

    target_right: Number  # speeds of the right and left wheels that the board aims at [rad/s]
    target_left: Number

    loops: Number  # firmware loops since the reset
    last_line: Number  # number of the newest feedback line that has arrived
    feedback_age: Number  # of the newest feedback [s]
    read_speed: WheelNumber  # wheel speeds by the newest feedback [rad/s]
    odom_x: Number  # pose by odometry [m, m, rad]
    odom_y: Number
    odom_theta: Number
    linear: Number  # twist by odometry [m/s, rad/s]
    angular: Number

    goal_x: Number  # the goal in the odometry frame [m]
    goal_y: Number
    goal_given: Number
    """Whether the goal is a reset's option, so that the world's path doesn't lead to it."""
    action_linear: Number  # the newest action, -1 to 1
    action_angular: Number
    steps: Number  # env steps since the reset
    total_reward: Number
    outcome: Number  # see `tasks.task.Outcome`
    true_contact: Number  # whether the robot has touched an obstacle
    world: Number  # index of the world
    start_x: Number
    """The start in the frame of the world [m, m, rad], and cosine and sine of its direction."""
    start_y: Number
    start_theta: Number
    start_cos: Number
    start_sin: Number
    scan_start: Number  # when the LiDAR's clock began: the time of the reset [s]
    scan_phase: Number  # phase of its revolution at that time, 0 to 1
    scan_key: Number  # key of its errors, 0 to 1
    scan_stamp: Number  # when the newest scan's revolution ended [s]

    sent_linear: Number  # the newest twist that was sent [m/s, rad/s]
    sent_angular: Number
    sent_reason: Number  # why it isn't the one asked for, see `safety.rules.Reason`
    latched: Number  # the reason that holds the robot until the reset
    new_linear: Number  # the newest twist by the limits, and the one before it [m/s, rad/s]
    new_angular: Number
    past_linear: Number
    past_angular: Number

    true_theta: Number  # only for info, as the next ones: the heading within half a turn [rad]
    true_goal_distance: Number  # [m]
    odometry_error: Number  # distance between the position and that by odometry [m]
    is_success: Number
    work: Number  # mechanical work of the motors, if the batch is `metered` [J]
    scan_age: Number  # [s]
    scan_stale: Number

    crowd_key: (
        Number  # the episode's draw for movers. this and the next ones are for worlds that move
    )
    crowd_look: Number  # the next tick in which the robot can touch a mover, or people walk
    closest_person: Number  # only for info, as the next ones [m]
    time_to_collision: Number  # [s]
    intrusions: Number  # how often the robot has entered a person's personal space
    person_contact: Number  # who ran into whom, see `worlds.crowd.ROBOT_HIT`


class Options:
    """Options of a reset, for this and all later episodes. Zero if there are none."""

    wished_world: Number  # index of the world, from 1
    wished_goal: Number  # whether a goal is asked for
    wished_x: Number  # that goal in the odometry frame [m]
    wished_y: Number
    first_rank: Number
    """Worlds of a range of difficulty have ranks from this one up to the next one."""
    last_rank: Number


class Build:
    """What follows from a robot's configuration. It is written once, when the batch is made."""

    kind: Number  # which of the batch's configurations it has: an index into arrays of kinds
    ramp: WheelNumber
    """Most that the set points of the four wheels change in a firmware loop [rad/s]."""
    counts_per_radian: Number  # encoder counts per angle of a wheel [1/rad]
    speed_per_count: Number  # wheel speed for one count within the encoders' window [rad/s]
    quantum: Number  # printed speeds are rounded to multiples of this [rad/s], or 0
    max_linear: Number  # linear velocity of a full action [m/s]
    max_angular: Number  # angular velocity of a full action [rad/s]
    stale: Number  # age from which a scan counts as stale [s]
    rays: Number  # how many rays its LiDAR has
    first_world: Number  # index of the first world for its footprint
    worlds: Number  # how many there are


class Robots(Episode, Options, Build):
    """The robots of a block."""

    command_loops: Number  # how long this episode's commands are on their way [firmware loops]
    feedback_delay: Number  # how long this episode's feedback is on its way [firmware loops]
    physics: Any
    """The fields of `Physics`, drawn for the episode. Numbers of wheels are like `gain`,
    (4, robots)."""
    rules: Any
    """The fields of `SafetyRules`, see `rules_of`. Those of an axis are like
    `linear.max_velocity`. (A record for each kind of robots would take half as long again in
    every step, because loops over robots can't be vectorized then.)"""


def _fields(kind: type) -> Fields:
    """Fields of a record for the numbers that a class declares."""
    return [
        (name, np.float64, (*hint.__metadata__[0], BLOCK_ROBOTS))
        for name, hint in inspect.get_annotations(kind, eval_str=True).items()
        if hint is not Any
    ]


def _physics_fields() -> Fields:
    """Fields of a record for `Physics`. Those of four wheels, named _a to _d, are one field."""
    fields: Fields = []
    for name in Physics._fields:
        stem, _, wheel = name.rpartition("_")
        if wheel == "a":
            fields.append((stem, np.float64, (4, BLOCK_ROBOTS)))
        elif wheel not in tuple("bcd"):
            fields.append((name, np.float64, (BLOCK_ROBOTS,)))
    return fields


def _rules_fields(kind: Any) -> list[Any]:
    """Fields of a record for `SafetyRules`, without the period, which robots share."""
    return [
        (name, _rules_fields(hint)) if hint is AxisLimits else (name, np.float64, (BLOCK_ROBOTS,))
        for name, hint in get_type_hints(kind).items()
        if name != "period"
    ]


BLOCK = np.dtype(
    [
        *_fields(Episode),
        *_fields(Options),
        *_fields(Robots),
        ("physics", _physics_fields()),
        *_fields(Build),
        ("rules", _rules_fields(SafetyRules)),
    ]
)
"""The record of a block: `Robots`."""
ROWS = {
    name: range(offset // (8 * BLOCK_ROBOTS), (offset + kind.itemsize) // (8 * BLOCK_ROBOTS))
    for name, (kind, offset, *_) in (BLOCK.fields or {}).items()
}
"""Rows of a field if a block is seen as a matrix of numbers and robots, see `view_numbers`."""
OPTIONS = tuple(name for name, *_ in _fields(Options))
EPISODE_ROWS = ROWS[OPTIONS[0]].start
"""How many rows an episode has. They are the first ones."""
PHYSICS_ROW = ROWS["physics"].start


def make_blocks(robots: int) -> NDArray[Any]:
    """Blocks for these robots, all zero. The last block may have room for more."""
    return np.zeros(-(-robots // BLOCK_ROBOTS), BLOCK)


def view_numbers(blocks: NDArray[Any]) -> Floats:
    """The same memory as (blocks, rows, BLOCK_ROBOTS), for what treats many fields alike."""
    return np.asarray(blocks).view(np.float64).reshape(len(blocks), -1, BLOCK_ROBOTS)


def read_fields(blocks: NDArray[Any], names: Sequence[str], robots: Any) -> Floats:
    """Copy fields of some robots, (numbers, robots). Those of wheels are four numbers."""
    rows = [row for name in names for row in ROWS[name]]
    numbers = view_numbers(blocks)[:, rows].swapaxes(0, 1).reshape(len(rows), -1)
    fields: Floats = numbers[:, robots]
    return fields


Records = Any
"""A record of Setup, see `jit.record_of`. Named tuples of this many numbers take long to
compile."""


class Setup(NamedTuple):
    """Numbers that all robots of a batch share."""

    dt: float  # duration of a firmware loop, which is also the physics' step [s]
    period: float  # duration of a tick, the control period [s]
    wire_time: float  # time from writing a line to its use, without further delays [s]
    isotropic: bool  # whether the tyres of all robots have equal friction in all directions
    window: int  # firmware loops over which the encoders average
    ticks: int  # control periods in an env step
    loops: int  # firmware loops in a control period
    max_steps: float  # time limit of an episode [env steps], infinite for none
    sees: bool  # whether the robots have a LiDAR
    numbers: int
    """Numbers of an observation that are the task's own. Those of the sensors follow."""
    first_ray: int  # column of the LiDAR's first number in an observation
    metered: bool = False  # whether the work of the motors is measured


class Cursor(NamedTuple):
    """Where the rings of a batch are after the last step. Slots of a ring are used in turn."""

    counts: int  # slot of `Tables.counts` that the last firmware loop wrote
    commands: int  # slot of `Tables.commands` that the last tick wrote


class Spawns(NamedTuple):
    """Starts, goals and paths of the worlds, and the goal distances for an open floor."""

    min_distance: float  # nearest goal on an open floor [m]
    max_distance: float  # farthest goal on an open floor [m]
    starts: Any  # (worlds,): records of START
    goals: Any  # (worlds,): records of GOAL
    lengths: Floats  # (worlds,): lengths of the worlds' paths [m]
    paths: Floats
    """(worlds, samples, 3): the paths to follow, x [m], y [m], direction [rad], in the odometry
    frame. One world without samples if the task follows no path."""
    samples: NDArray[np.int64]
    """(worlds,): number of samples of each path."""
    order: NDArray[np.int64]
    """(worlds,): indices of the worlds from the easiest to the hardest, of one footprint's worlds
    after another's."""


START = np.dtype([("x", "f8"), ("y", "f8"), ("radius", "f8"), ("theta", "f8")])
"""A disc in which episodes start [m], and their heading [rad], NaN for any heading."""
GOAL = np.dtype([("x", "f8"), ("y", "f8"), ("radius", "f8")])
"""A disc in which goals are [m]."""


class Tables(NamedTuple):
    """The arrays of a batch of R robots that all loops need."""

    blocks: Any  # (blocks,): records of `Robots`
    counts: Floats  # (blocks, firmware loops, 4, BLOCK_ROBOTS): a ring of encoder counts
    commands: Floats
    """(blocks, ticks, 2, BLOCK_ROBOTS): a ring of command lines, wheel speeds of RIGHT and LEFT
    [rad/s], each kept until the board uses it."""
    cursor: Any  # (1,): record of `Cursor`
    random: NDArray[np.uint64]
    """(R, 4): generators, see `pcg`."""
    actions: Floats  # (R, 2): linear and angular, of the step
    begins: NDArray[np.bool_]  # (R,): whether the robot starts an episode in this step or reset
    drives: NDArray[np.bool_]  # (R,): whether the robot drives in this step
    ranges: Floats
    """(R, rays): the LiDAR's newest scan [m]. A robot may have fewer, see `Build.rays`."""
    edges: Floats
    """(kinds, rays): distance from the LiDAR to the edge of the footprint along each ray [m]."""
    observations: NDArray[np.float32]
    """(R, numbers)."""
    rewards: Floats  # (R,)
    terminated: NDArray[np.bool_]  # (R,)
    truncated: NDArray[np.bool_]  # (R,)


class Draws(NamedTuple):
    """What the physics of episodes is drawn from, and what was drawn."""

    nominal: Floats  # (kinds, numbers): `Physics` as configured
    low: Floats  # (kinds, numbers): least value of each randomized number, see `DrawnRanges`
    high: Floats  # (kinds, numbers): largest value of each randomized number
    delays: Floats  # (kinds, delays): what randomized delays of commands are drawn from [s]
    delay_counts: NDArray[np.int64]
    """(kinds,): how many of these a kind has."""
    drawn: Floats  # (R, numbers): what the episodes have drawn. No numbers if nothing varies


# Loops get None in the place of the next ones if a batch doesn't need them, and numba then leaves
# out what depends on `if scans is not None`: most batches compile less than half of the code.


class Scans(NamedTuple):
    """What LiDARs and contacts need, for robots with a LiDAR, or in worlds with obstacles."""

    around: Surroundings  # obstacles and rays
    rays: NDArray[Any]  # (kinds,): records of `Rays`
    trails: Floats
    """(2, R, slots, 4): where the robots were in the last ticks, by ODOMETRY and in TRUTH, as
    `Trail.rows`. No slots without a LiDAR."""


class Crowds(NamedTuple):
    """What moves in the worlds, around each robot."""

    motions: Motions  # of each world
    states: Floats
    """(R, movers, numbers): see `worlds.crowd.STATE_NUMBERS`."""
    trails: Floats
    """(R, slots, movers, 2): where they were, in the rows of `Scans.trails`."""


class Maps(NamedTuple):
    """The robots' maps."""

    records: NDArray[Any]  # (R,): `sensors.map.RECORD`
    scratch: NDArray[np.int32]
    """(blocks, numbers): for the search of ways."""


@jit
def limits_of(axis: Any, i: int) -> AxisLimits:
    """The limits of an axis of robot i."""
    return AxisLimits(
        min_velocity=axis.min_velocity[i],
        max_velocity=axis.max_velocity[i],
        min_acceleration=axis.min_acceleration[i],
        max_acceleration=axis.max_acceleration[i],
        min_jerk=axis.min_jerk[i],
        max_jerk=axis.max_jerk[i],
        min_reverse=axis.min_reverse[i],
        max_reverse=axis.max_reverse[i],
    )


@jit
def rules_of(robots: Robots, i: int, period: float) -> SafetyRules:
    """The safety rules of robot i. `period` is the setup's."""
    rules = robots.rules

    return SafetyRules(
        period=period,
        free=rules.free[i] > 0.0,
        linear=limits_of(rules.linear, i),
        angular=limits_of(rules.angular, i),
        min_x=rules.min_x[i],
        max_x=rules.max_x[i],
        min_y=rules.min_y[i],
        max_y=rules.max_y[i],
        stale=rules.stale[i],
        timeout=rules.timeout[i],
        left_radius=rules.left_radius[i],
        right_radius=rules.right_radius[i],
        separation=rules.separation[i],
        top=rules.top[i],
    )


@jit
def robots_of_block(block: int, robots: int) -> int:
    """How many of a batch's robots are in a block."""
    return min(robots - block * BLOCK_ROBOTS, BLOCK_ROBOTS)


@jit
def to_world(robots: Robots, i: int, x: float, y: float) -> tuple[float, float]:
    """Transform a point of robot i's odometry frame into the frame of its world [m]."""
    cos = robots.start_cos[i]
    sin = robots.start_sin[i]
    return (
        robots.start_x[i] + cos * x - sin * y,
        robots.start_y[i] + sin * x + cos * y,
    )
