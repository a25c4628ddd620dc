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

from acsar_gym.jit import jit
from acsar_gym.physics import Physics
from acsar_gym.safety.rules import AxisLimits, SafetyRules
from acsar_gym.worlds.geometry import Surroundings
from acsar_gym.worlds.movers import Motions

Floats = NDArray[np.float64]
Number = Annotated[Floats, ()]  # a number of each robot of a block, (BLOCK_ROBOTS,)
WheelNumber = Annotated[Floats, (4,)]
"""A number of each wheel of each robot of a block, (4, BLOCK_ROBOTS), in the order of wheels."""

BLOCK_ROBOTS = 64
"""Robots of a block. They go through a whole env step together, so that they stay in the cache."""
TURN = 2.0 * math.pi


class Episode:
    """Numbers that are zero when an episode begins; flags and codes are numbers, too.

    Where a board falls silent in a step, they become again what they were before it.
    """

    x: Number  # position of the body [m], in the odometry frame as the next ones
    y: Number
    theta: Number  # its heading [rad]
    vx: Number  # its velocity [m/s]
    vy: Number
    rate: Number  # its yaw rate [rad/s]
    wheel_speed: WheelNumber  # [rad/s]
    set_point: WheelNumber  # speeds that the board asks of the motors [rad/s]
    wheel_angle: WheelNumber  # [rad]

    target_right: Number  # speeds of the right and left wheels that the board aims at [rad/s]
    target_left: Number
    new_right: Number
    """Those of the newest command, as the next ones where it is the same in all ticks of a step."""
    new_left: Number
    heard: Number  # from which firmware loop of a step the board knows the newest command

    loops: Number  # firmware loops since the reset
    last_line: Number  # number of the newest feedback line that has arrived
    age: Number  # of the newest feedback [s]
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
    contact: Number  # whether the robot has touched an obstacle
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
    reason: Number  # why it isn't the one asked for, see `safety.rules.Reason`
    latched: Number  # the reason that holds the robot until the reset
    new_linear: Number  # the newest twist by the limits, and the one before it [m/s, rad/s]
    new_angular: Number
    past_linear: Number
    past_angular: Number

    true_theta: Number  # for info alone, as the next ones: the heading within half a turn [rad]
    goal_distance: Number  # [m]
    odom_error: Number  # distance between the position and that by odometry [m]
    success: Number
    work: Number  # mechanical work of the motors, where the batch is `metered` [J]
    scan_age: Number  # [s]
    scan_stale: Number

    crowd_key: Number  # the episode's draw for movers, as the next ones where worlds move
    crowd_look: Number  # the next tick in which the robot can touch a mover, or people walk
    closest_person: Number  # for info alone, as the next ones [m]
    time_to_collision: Number  # [s]
    intrusions: Number  # how often the robot has entered somebody's personal space
    person_contact: Number  # who ran into whom, see `worlds.crowd.ROBOT_HIT`

    key: Number
    """The episode's, which decides on lost and late lines; negative where none are. This and the
    next ones are used where lines may be lost or late."""
    last_command: Number  # the newest command that the wire has passed on or lost
    command_release: Number  # when it passed on the newest command [s]
    feedback_release: Number  # when it passed on the newest feedback [s]
    board_free: Number  # when the board's UART is free [s]
    heard_tick: Number  # up to which tick the board has taken over commands
    heard_loop: Number  # in which firmware loop the board got the newest command
    silent: Number  # whether the board was silent in the reset
    fault: Number  # the code of info


class Options:
    """Options of a reset, for this and all later episodes; zero where there are none."""

    wished_world: Number  # index of the world, from 1
    wished_goal: Number  # whether a goal is asked for
    wished_x: Number  # that goal in the odometry frame [m]
    wished_y: Number
    first_rank: Number
    """Worlds of a range of difficulty have ranks from this one up to the next one."""
    last_rank: Number


class Build:
    """What follows from a robot's configuration; written once, when the batch is made."""

    kind: Number  # which of the batch's configurations it has: an index into arrays of kinds
    ramp: WheelNumber
    """Most that the set points of the four wheels change in a firmware loop [rad/s]."""
    counts_per_radian: Number  # encoder counts per angle of a wheel [1/rad]
    speed_per_count: Number  # wheel speed for one count within the encoders' window [rad/s]
    quantum: Number  # printed speeds are rounded to multiples of this [rad/s]; 0 where they aren't
    max_linear: Number  # linear velocity of a full action [m/s]
    max_angular: Number  # angular velocity of a full action [rad/s]
    stale: Number  # age from which a scan counts as stale [s]
    rays: Number  # how many rays its LiDAR has
    first_world: Number  # index of the first world that was made for its footprint
    worlds: Number  # how many there are


class Robots(Episode, Options, Build):
    """The robots of a block."""

    command_loops: Number  # how long this episode's commands are on their way [firmware loops]
    feedback_delay: Number  # how long this episode's feedback is on its way [firmware loops]
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
    fields: list[tuple[str, Any, tuple[int, ...]]] = []
    for name in Physics._fields:
        stem, _, wheel = name.rpartition("_")
        if wheel == "a":
            fields.append((stem, np.float64, (4, BLOCK_ROBOTS)))
        elif wheel not in tuple("bcd"):
            fields.append((name, np.float64, (BLOCK_ROBOTS,)))
    return fields


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
BUILD_ROW = ROWS[BUILD[0]].start  # the first row of `Build` and `rules`; they are the last ones


def make_blocks(robots: int) -> NDArray[Any]:
    """Blocks for so many robots, all zero; the last block may have more."""
    return np.zeros(-(-robots // BLOCK_ROBOTS), BLOCK)


def view_numbers(blocks: NDArray[Any]) -> Floats:
    """The same memory as (blocks, rows, BLOCK_ROBOTS)."""
    return np.asarray(blocks).view(np.float64).reshape(len(blocks), -1, BLOCK_ROBOTS)


def read_fields(numbers: Floats, names: Sequence[str], robots: Any) -> Floats:
    """Copy fields of some robots, (numbers, robots); those of wheels are four numbers."""
    rows = [row for name in names for row in ROWS[name]]
    fields: Floats = numbers[:, rows].swapaxes(0, 1).reshape(len(rows), -1)[:, robots]
    return fields


class LineFaults(NamedTuple):
    """Faults of the lines between drivers and boards; see `links.faults.Faults`."""

    possible: bool  # whether any fault can occur
    episodes: float  # share of episodes that have faults
    feedback: bool  # whether feedback lines have faults
    commands: bool  # whether command lines have faults
    dropped: float  # share of lines that are lost
    late: float  # share of lines that are late
    lateness: float  # how much later they are [s]
    patience: float  # ticks that a reset waits for the wheels to stand, at most
    line_time: float  # duration of a command line on the wire [s]
    processing_time: float  # from the last byte of a command to its use by the board [s]
    command_timeout: float  # A board that gets no command for so long stops its motors [s]


Records = Any
"""A record of Setup, see `jit.record_of`: named tuples of so many numbers take long to compile."""


class Setup(NamedTuple):
    """Numbers that all robots of a batch share."""

    dt: float  # duration of a firmware loop, which is also the physics' step [s]
    period: float  # duration of a tick, the control period [s]
    wire_time: float  # time from writing a line to its use, without further delays [s]
    isotropic: bool  # whether the tyres of all robots have equal friction in all directions
    window: int  # firmware loops over which the encoders average
    ticks: int  # control periods in an env step
    loops: int  # firmware loops in a control period
    max_steps: float  # time limit of an episode [env steps]; infinite for none
    faults: LineFaults  # faults of the lines
    sees: bool  # whether the robots have a LiDAR
    numbers: int
    """Numbers of an observation that are the task's own; those of the sensors follow, those of map
    and LiDAR first."""
    first_ray: int  # place of the LiDAR's first number in an observation
    metered: bool = False  # whether the work of the motors is measured


class Spawns(NamedTuple):
    """Starts, goals and paths of the worlds; the goal distances for an open floor."""

    min_distance: float  # nearest goal on an open floor [m]
    max_distance: float  # farthest goal on an open floor [m]
    starts: Floats  # (worlds, 4): x, y, radius [m] and theta [rad], NaN for any direction
    goals: Floats  # (worlds, 3): x, y, radius [m]
    lengths: Floats  # (worlds,): lengths of the worlds' paths [m]
    paths: Floats
    """(worlds, samples, 3): the paths to follow, x [m], y [m], direction [rad], in the odometry
    frame; one world without samples where the task follows none."""
    samples: NDArray[np.int64]
    """(worlds,): number of samples of each path."""
    order: NDArray[np.int64]
    """(worlds,): indices of the worlds from the easiest to the hardest, of one footprint's worlds
    after another's."""


class Tables(NamedTuple):
    """The arrays of a batch of R robots that all loops need."""

    blocks: Any  # (blocks,): records of `Robots`
    numbers: Floats
    """(blocks, rows, BLOCK_ROBOTS): the same memory, for what treats many fields alike."""
    counts: Floats  # (blocks, firmware loops, 4, BLOCK_ROBOTS): a ring of encoder counts
    random: NDArray[np.uint64]
    """(R, 4): generators, see `pcg`."""
    actions: Floats  # (R, 2): linear and angular, as given to the step
    over: NDArray[np.bool_]  # (R,): whether the robot begins a new episode in this step or reset
    idle: NDArray[np.bool_]
    """(R,): whether the robot doesn't drive: it begins anew, its board is silent, or this is a
    reset."""
    ranges: Floats
    """(R, rays): the LiDAR's newest scan [m]; a robot may have fewer, see `Build.rays`."""
    edges: Floats
    """(kinds, rays): distance from the LiDAR to the edge of the footprint along each ray [m]."""
    observations: NDArray[np.float32]
    """(R, numbers)."""
    rewards: Floats  # (R,)
    ends: NDArray[np.bool_]  # (2, R): terminated, truncated
    ring: NDArray[np.int64]
    """(4,): the slot of `counts` that the last loop of the last step wrote, the slot of
    `Commands` that its last tick wrote, and the first tick (and the one after the last) of a
    step that the next call drives."""


class Draws(NamedTuple):
    """What the physics of episodes is drawn from, and what was drawn."""

    nominal: Floats  # (kinds, numbers): `Physics` as configured
    low: Floats  # (kinds, numbers): least value of each randomized number, see `DrawnRanges`
    high: Floats  # (kinds, numbers): largest value of each randomized number
    delays: Floats  # (kinds, delays): what randomized delays of commands are drawn from [s]
    delay_counts: NDArray[np.int64]
    """(kinds,): how many of these a kind has."""
    drawn: Floats  # (R, numbers): what the episodes have drawn; no numbers where nothing varies


# Loops get None in the place of these where a batch doesn't need them, and numba then leaves away
# what stands behind `if scans is not None`: most batches compile less than half of the code.


Commands = Floats
"""(blocks, ticks, 2, BLOCK_ROBOTS): a ring of command lines, wheel speeds right and left [rad/s],
each kept until the board uses it. For limits, a geofence, faults, and commands that take longer
than a step."""


class Lines(NamedTuple):
    """Lines that may be lost or late, see `LineFaults`."""

    arrivals: Floats
    """(blocks, ticks, 3, BLOCK_ROBOTS): the firmware loop in which the boards get what the wire
    passed on in a tick, and its two wheel speeds."""
    kept: Floats
    """(blocks, EPISODE_ROWS, BLOCK_ROBOTS): the episodes before the step; no rows where boards
    can't fall silent."""


class Scans(NamedTuple):
    """What LiDARs and contacts need: robots with a LiDAR, or in worlds with obstacles."""

    around: Surroundings  # obstacles and rays
    rays: NDArray[Any]  # (kinds,): records of `Rays`
    trails: Floats
    """(2, R, slots, 4): where the robots were in the last ticks, by odometry and in truth, as
    `Trail.rows`; no slots without a LiDAR."""


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
def rules_of(robots: Robots, i: int, period: float) -> SafetyRules:
    """The safety rules of robot i; `period` is the setup's."""
    rules = robots.rules
    return SafetyRules(
        period,
        rules.free[i] > 0.0,
        AxisLimits(
            rules.linear_min_velocity[i],
            rules.linear_max_velocity[i],
            rules.linear_min_acceleration[i],
            rules.linear_max_acceleration[i],
            rules.linear_min_jerk[i],
            rules.linear_max_jerk[i],
            rules.linear_min_reverse[i],
            rules.linear_max_reverse[i],
        ),
        AxisLimits(
            rules.angular_min_velocity[i],
            rules.angular_max_velocity[i],
            rules.angular_min_acceleration[i],
            rules.angular_max_acceleration[i],
            rules.angular_min_jerk[i],
            rules.angular_max_jerk[i],
            rules.angular_min_reverse[i],
            rules.angular_max_reverse[i],
        ),
        rules.min_x[i],
        rules.max_x[i],
        rules.min_y[i],
        rules.max_y[i],
        rules.stale[i],
        rules.timeout[i],
        rules.left_radius[i],
        rules.right_radius[i],
        rules.separation[i],
        rules.top[i],
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
