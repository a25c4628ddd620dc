"""What movers do in an episode: where they are, whom they keep away from, and whom they touch.

Once a control period `advance_crowd` puts those that follow their motion where it is, and lets
people who react walk on. These are driven by the social force model of D. Helbing and P. Molnar,
"Social force model for pedestrian dynamics", Physical Review E 51 (1995): each adapts its velocity
to the way that it wants to go, and is pushed away from others by an exponential potential, whose
equipotential lines are ellipses along the other's next steps. Walls push as in D. Helbing, I. Farkas
and T. Vicsek, "Simulating dynamical features of escape panic", Nature 407 (2000), whose range lets
people through doors. A person decides anew every REACTION_TIME, and walks on in between.

One robot (`Crowd`) and a batch call the same functions.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.hashing import hash_sample
from acsar_gym.jit import jit, loop, subroutine
from acsar_gym.worlds.geometry import (
    Obstacles,
    Surroundings,
    footprint_gap,
    make_surroundings,
)
from acsar_gym.worlds.movers import (
    RADIUS,
    REACTS,
    SEES_ROBOT,
    SPEED,
    Motions,
    draw_offset,
    locate_mover,
    make_motions,
    may_jump,
)
from acsar_gym.worlds.world import World

Floats = NDArray[np.float64]
REACTION_TIME = 0.1  # a person who reacts decides so often [s]
RELAXATION_TIMES = (0.4, 0.6)
"""In about this time a person's velocity becomes the wanted one, drawn for each [s]; published:
0.5."""
STRENGTHS = (1.5, 2.7)
"""Strength of the push of others, drawn for each [m^2/s^2]; published: 2.1."""
PUSH_RANGE = 0.3  # range of that push [m]
STRIDE_TIME = 2.0  # the push's ellipse reaches along the other's way of so long [s]
WALL_PUSH = 25.0  # push of a wall that a person touches [m/s^2]
WALL_RANGE = 0.08  # range of that push [m]
SIGHT_COSINE = math.cos(math.radians(100.0))  # others beyond this bearing are behind a person
BEHIND_SHARE = 0.5  # share of the push of others that are behind
SPEED_SHARE = 1.3  # greatest speed, in parts of that of the motion
MOST_PUSH = 10.0  # greatest acceleration [m/s^2]
LONGEST_LOOK = 1.0  # a mover that is far away is looked at so often, at least [s]
FARTHEST_PUSH = 6.0  # others that are farther away don't push [m]
LOOKAHEAD_TIME = 0.5  # a person walks to where the motion will be in this time [s]
LEASH = 1.0  # the motion waits for a person who is so far behind [m]
PERSONAL_SPACE = 0.45
"""Distance between two hulls within which a person feels intruded upon [m]: the farther limit of
the intimate distance in E. T. Hall, "The Hidden Dimension" (1966)."""
STANDING_SPEED = 0.05
"""A robot that comes nearer to a person by no more than this hasn't run into it [m/s]."""
FARTHEST_PERSON = 100.0  # distances to the nearest mover are at most this [m]
FARTHEST_COLLISION = 10.0  # times to collision are at most this [s]

X, Y, VX, VY, CLOCK, AX, AY, NEAR, LOOK = range(9)
STATE_NUMBERS = 9
"""Columns of the state of a mover: place [m], velocity [m/s], the time of its motion, at the
episode's begin or, of a person who reacts, now [s], that person's acceleration [m/s^2], whether the
robot is within its personal space, and the next tick in which it can be."""
TRAITS, TRAIT_NUMBERS = 1000, 2
"""Samples of a person's own numbers begin there, so many for each."""
NO_HIT, ROBOT_HIT, PERSON_HIT = 0.0, 1.0, 2.0
"""What `advance_crowd` says of contacts: none, the robot ran into a mover, or a mover into it."""


Pose = tuple[float, float, float]  # x [m], y [m], theta [rad]
Twist = tuple[float, float]  # forward speed [m/s], yaw rate [rad/s]


class RobotMotion(NamedTuple):
    """Where a robot is in the frame of the world, and how it moves [m, m/s, rad/s]."""

    x: float
    y: float
    cos: float
    sin: float
    forward: float
    rate: float


@subroutine
def begin_crowd(movers: Floats, pieces: Floats, states: Floats, key: float) -> None:
    """Put all movers where an episode begins."""
    for m in range(len(movers)):
        if movers[m, RADIUS] < 0.0:
            break
        for k in range(STATE_NUMBERS):
            states[m, k] = 0.0
        states[m, CLOCK] = draw_offset(movers[m], m, key)
        place_mover(movers[m], pieces, states[m], 0.0)


@jit
def place_mover(mover: Floats, pieces: Floats, state: Floats, time: float) -> None:
    """Put a mover that doesn't react where its motion is at a time since the episode's begin."""
    state[X], state[Y], state[VX], state[VY] = locate_mover(mover, pieces, time + state[CLOCK])


@subroutine
def advance_crowd(
    movers: Floats,
    pieces: Floats,
    states: Floats,
    tick: int,
    period: float,
    key: float,
    robot: RobotMotion,
    top_speed: float,
    which: int,
    around: Surroundings,
    kind: int,
) -> tuple[float, float, float]:
    """Advance all movers of a robot's world to the end of a tick, and look for contacts.

    Args:
        movers: (movers, numbers): of the world, see `Motions`.
        pieces: of the world.
        states: (movers, STATE_NUMBERS): they change.
        tick: its number since the episode's begin, from 1.
        period: of a tick [s].
        key: the episode's, 0 to 1.
        robot: at the end of the tick.
        top_speed: the robot won't move faster [m/s]. Where nobody reacts, movers that are too far
            away to touch it in the next ticks stay where they are, until `place_crowd`. inf: all
            are moved.
        which: the world's place in `around`.
        around: obstacles, and footprints.
        kind: of the robot.

    Returns:
        Whether somebody ran into somebody, such as ROBOT_HIT, how often the robot has entered
        somebody's personal space, and the next tick in which it can, or nobody reacts.
    """
    now, every = tick * period, max(int(np.floor(REACTION_TIME / period + 0.5)), 1)
    outer = math.sqrt(around.kinds[kind, 5] ** 2 + around.kinds[kind, 6] ** 2)
    hit, entered, next_look = NO_HIT, 0.0, np.inf
    for m in range(len(movers)):
        radius = movers[m, RADIUS]
        if radius < 0.0:
            break
        if tick < states[m, LOOK]:
            next_look = min(next_look, states[m, LOOK])
            continue
        states[m, LOOK] = tick + 1.0
        if movers[m, REACTS] == 0.0:
            place_mover(movers[m], pieces, states[m], now)
        else:
            if (tick + m) % every == 0:
                decide_step(movers, pieces, states, m, key, robot, outer, which, around)
            walk_on(movers[m], pieces, states[m], period)
        dx, dy = states[m, X] - robot.x, states[m, Y] - robot.y
        near, square = outer + radius + PERSONAL_SPACE, dx * dx + dy * dy
        if square > near * near:
            states[m, NEAR] = 0.0
            if top_speed < np.inf and not jumps_soon(movers[m], states[m], now):
                ticks = (math.sqrt(square) - near) / ((top_speed + movers[m, SPEED]) * period)
                states[m, LOOK] += min(np.floor(ticks), np.floor(LONGEST_LOOK / period) - 1.0)
            next_look = min(next_look, states[m, LOOK])
            continue
        next_look = tick + 1.0
        ahead, left = robot.cos * dx + robot.sin * dy, robot.cos * dy - robot.sin * dx
        gap, at_x, at_y = footprint_gap(ahead, left, around, kind)
        gap -= radius
        is_near = 1.0 if gap < PERSONAL_SPACE else 0.0
        entered += 1.0 if is_near > states[m, NEAR] else 0.0
        states[m, NEAR] = is_near
        if gap <= 0.0 and hit == NO_HIT:
            hit = ROBOT_HIT if comes_nearer(ahead, left, at_x, at_y, robot) else PERSON_HIT
    return hit, entered, next_look


@jit
def jumps_soon(mover: Floats, state: Floats, now: float) -> bool:
    """Whether a mover may jump while nobody looks."""
    return may_jump(mover, now + state[CLOCK], LONGEST_LOOK)


@subroutine
def place_crowd(movers: Floats, pieces: Floats, states: Floats, time: float) -> None:
    """Put all movers that don't react where they are at a time since the episode's begin [s]."""
    for m in range(len(movers)):
        if movers[m, RADIUS] < 0.0:
            break
        if movers[m, REACTS] == 0.0:
            place_mover(movers[m], pieces, states[m], time)


@jit
def comes_nearer(ahead: float, left: float, at_x: float, at_y: float, robot: RobotMotion) -> bool:
    """Whether the place (at_x, at_y) of a robot's hull moves towards a mover, in the base frame."""
    forward, sideways = robot.forward - robot.rate * at_y, robot.rate * at_x
    dx, dy = ahead - at_x, left - at_y
    apart = math.sqrt(dx * dx + dy * dy)
    if apart < 1e-9:  # the mover's middle is within the hull: seen from the robot's middle
        dx, dy = ahead, left
        apart = math.sqrt(dx * dx + dy * dy) + 1e-12
    nearer: bool = forward * dx + sideways * dy > STANDING_SPEED * apart
    return nearer


@jit
def draw_trait(key: float, mover: int, number: int, low: float, high: float) -> float:
    """Draw a person's own number, the same in the whole episode."""
    return low + (high - low) * hash_sample(key, TRAITS + mover * TRAIT_NUMBERS + number)


@subroutine
def decide_step(
    movers: Floats,
    pieces: Floats,
    states: Floats,
    m: int,
    key: float,
    robot: RobotMotion,
    outer: float,
    which: int,
    around: Surroundings,
) -> None:
    """Set the acceleration of person m until the next decision."""
    x, y, radius = states[m, X], states[m, Y], movers[m, RADIUS]
    relaxation = draw_trait(key, m, 0, RELAXATION_TIMES[0], RELAXATION_TIMES[1])
    strength = draw_trait(key, m, 1, STRENGTHS[0], STRENGTHS[1])
    clock = states[m, CLOCK] + LOOKAHEAD_TIME
    to_x, to_y, _, _ = locate_mover(movers[m], pieces, clock)
    want_x, want_y = (to_x - x) / LOOKAHEAD_TIME, (to_y - y) / LOOKAHEAD_TIME
    speed, most = math.sqrt(want_x * want_x + want_y * want_y), SPEED_SHARE * movers[m, SPEED]
    share = most / speed if speed > most else 1.0
    want_x, want_y, speed = share * want_x, share * want_y, share * speed
    ax, ay = (want_x - states[m, VX]) / relaxation, (want_y - states[m, VY]) / relaxation
    for n in range(len(movers) + 1):
        if n < len(movers):
            if n == m or movers[n, RADIUS] < 0.0:
                continue
            dx, dy = x - states[n, X], y - states[n, Y]
            vx, vy, both = states[n, VX], states[n, VY], radius + movers[n, RADIUS]
        else:
            if movers[m, SEES_ROBOT] == 0.0:
                continue
            dx, dy = x - robot.x, y - robot.y
            vx, vy = robot.forward * robot.cos, robot.forward * robot.sin
            both = radius + outer
        square = dx * dx + dy * dy
        if square > FARTHEST_PUSH * FARTHEST_PUSH:
            continue
        push_x, push_y = push_away(dx, dy, vx, vy, both, strength)
        seen = -(want_x * dx + want_y * dy) >= SIGHT_COSINE * speed * math.sqrt(square)
        share = 1.0 if seen else BEHIND_SHARE
        ax, ay = ax + share * push_x, ay + share * push_y
    far = radius + 8.0 * WALL_RANGE
    circles, segments = around.circles, around.segments
    for n in range(circles.shape[1]):
        dx, dy = x - circles[which, n, 0], y - circles[which, n, 1]
        reach = far + circles[which, n, 2]
        square = dx * dx + dy * dy
        if square < reach * reach:
            apart = math.sqrt(square) + 1e-9
            push = WALL_PUSH * math.exp((radius + circles[which, n, 2] - apart) / WALL_RANGE)
            ax, ay = ax + push * dx / apart, ay + push * dy / apart
    for n in range(segments.shape[1]):
        from_x, from_y = segments[which, n, 0], segments[which, n, 1]
        ex, ey = segments[which, n, 2] - from_x, segments[which, n, 3] - from_y
        share = ((x - from_x) * ex + (y - from_y) * ey) / (ex * ex + ey * ey + 1e-300)
        share = min(max(share, 0.0), 1.0)
        dx, dy = x - from_x - share * ex, y - from_y - share * ey
        square = dx * dx + dy * dy
        if square < far * far:
            apart = math.sqrt(square) + 1e-9
            push = WALL_PUSH * math.exp((radius - apart) / WALL_RANGE)
            ax, ay = ax + push * dx / apart, ay + push * dy / apart
    push = math.sqrt(ax * ax + ay * ay)
    share = MOST_PUSH / push if push > MOST_PUSH else 1.0
    states[m, AX], states[m, AY] = share * ax, share * ay


@jit
def push_away(
    dx: float, dy: float, vx: float, vy: float, both: float, strength: float
) -> tuple[float, float]:
    """Push on a person who is at (dx, dy) from another one that moves at (vx, vy) [m/s^2].

    The potential is strength * exp(-(b - both) / PUSH_RANGE), b being the semi-minor axis of the
    ellipse, and `both` the radii of the two, which the published one leaves out.
    """
    stride_x, stride_y = STRIDE_TIME * vx, STRIDE_TIME * vy
    apart = math.sqrt(dx * dx + dy * dy) + 1e-9
    later_x, later_y = dx - stride_x, dy - stride_y
    later = math.sqrt(later_x * later_x + later_y * later_y) + 1e-9
    around, stride = apart + later, stride_x * stride_x + stride_y * stride_y
    axis = 0.5 * math.sqrt(max(around * around - stride, 1e-6))
    push = strength / PUSH_RANGE * math.exp(min((both - axis) / PUSH_RANGE, 2.0))
    push *= around / (4.0 * axis)
    return push * (dx / apart + later_x / later), push * (dy / apart + later_y / later)


@subroutine
def walk_on(mover: Floats, pieces: Floats, state: Floats, period: float) -> None:
    """Let a person who reacts walk for a tick."""
    vx, vy = state[VX] + state[AX] * period, state[VY] + state[AY] * period
    speed, most = math.sqrt(vx * vx + vy * vy), SPEED_SHARE * mover[SPEED]
    share = most / speed if speed > most else 1.0
    state[VX], state[VY] = share * vx, share * vy
    state[X] += state[VX] * period
    state[Y] += state[VY] * period
    x, y, _, _ = locate_mover(mover, pieces, state[CLOCK])
    dx, dy = x - state[X], y - state[Y]
    state[CLOCK] += period * max(1.0 - math.sqrt(dx * dx + dy * dy) / LEASH, 0.0)


@subroutine
def survey_crowd(
    movers: Floats, states: Floats, robot: RobotMotion, around: Surroundings, kind: int
) -> tuple[float, float]:
    """Measure how near the robot is to movers.

    Returns:
        Distance from its hull to the nearest one's [m], 0 to FARTHEST_PERSON, and the time until
        its disc would touch one if all kept their velocities [s], at most FARTHEST_COLLISION.
    """
    nearest, soonest = FARTHEST_PERSON, FARTHEST_COLLISION
    outer = math.sqrt(around.kinds[kind, 5] ** 2 + around.kinds[kind, 6] ** 2)
    for m in range(len(movers)):
        radius = movers[m, RADIUS]
        if radius < 0.0:
            break
        dx, dy = states[m, X] - robot.x, states[m, Y] - robot.y
        apart = math.sqrt(dx * dx + dy * dy)
        if apart - outer - radius < nearest:
            ahead, left = robot.cos * dx + robot.sin * dy, robot.cos * dy - robot.sin * dx
            gap, _, _ = footprint_gap(ahead, left, around, kind)
            nearest = min(nearest, max(gap - radius, 0.0))
        vx = states[m, VX] - robot.forward * robot.cos
        vy = states[m, VY] - robot.forward * robot.sin
        soonest = min(soonest, time_to_touch(dx, dy, vx, vy, outer + radius))
    return nearest, soonest


@jit
def time_to_touch(dx: float, dy: float, vx: float, vy: float, both: float) -> float:
    """Time until two discs touch that keep their velocities [s]; inf where they never do.

    `dx`, `dy` is the place and `vx`, `vy` the velocity of one from the other, `both` the sum of
    their radii [m, m/s].
    """
    square, along, apart = vx * vx + vy * vy, dx * vx + dy * vy, dx * dx + dy * dy - both * both
    if apart <= 0.0:
        return 0.0
    inside = along * along - square * apart
    if along >= 0.0 or inside < 0.0:
        return np.inf
    return apart / (math.sqrt(inside) - along)


@loop
def begin_alone(motions: Motions, states: Floats, key: float) -> None:
    """`begin_crowd` for one robot."""
    begin_crowd(motions.movers[0], motions.pieces[0], states, key)


@loop
def advance_alone(
    motions: Motions,
    states: Floats,
    tick: int,
    period: float,
    key: float,
    pose: Pose,
    twist: Twist,
    around: Surroundings,
) -> tuple[float, float, float]:
    """`advance_crowd` for one robot."""
    robot = RobotMotion(pose[0], pose[1], math.cos(pose[2]), math.sin(pose[2]), *twist)
    movers, pieces = motions.movers[0], motions.pieces[0]
    return advance_crowd(movers, pieces, states, tick, period, key, robot, np.inf, 0, around, 0)


@loop
def survey_alone(
    motions: Motions, states: Floats, pose: Pose, twist: Twist, around: Surroundings
) -> tuple[float, float]:
    """`survey_crowd` for one robot."""
    robot = RobotMotion(pose[0], pose[1], math.cos(pose[2]), math.sin(pose[2]), *twist)
    return survey_crowd(motions.movers[0], states, robot, around, 0)


class Crowd:
    """The movers around one simulated robot, in one episode.

    Attributes: `motions`, of this world alone; `radii`, (movers,) [m]; `states`, (movers, STATE_NUMBERS); `hit`, the first contact,
    such as ROBOT_HIT; `intrusions`, how often the robot has entered somebody's personal space.
    """

    def __init__(self, world: World, config: RobotConfig, key: float) -> None:
        self.motions = make_motions([world.movers])
        self._period = config.period
        self._key = key
        obstacles = Obstacles(world.circles, world.segments)
        self._around = make_surroundings(obstacles, None, 1, config)
        self.radii = self.motions.movers[0, :, RADIUS].copy()
        self.states = np.zeros((len(self.radii), STATE_NUMBERS))
        self.hit, self.intrusions, self._tick = NO_HIT, 0.0, 0
        begin_alone(self.motions, self.states, key)

    def advance(self, pose: Pose, twist: Twist) -> None:
        """Advance by a control period, at whose end the robot is there and moves so."""
        self._tick += 1
        hit, entered, _ = advance_alone(
            self.motions,
            self.states,
            self._tick,
            self._period,
            self._key,
            pose,
            twist,
            self._around,
        )
        self.hit = self.hit or hit
        self.intrusions += entered

    def survey(self, pose: Pose, twist: Twist) -> tuple[float, float]:
        """Distance of the nearest mover [m] and time to collision [s], see `survey_crowd`."""
        return survey_alone(self.motions, self.states, pose, twist, self._around)
