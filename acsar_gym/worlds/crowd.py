"""What movers do in an episode: where they are, whom they keep away from, and whom they touch.

Once a control period `advance_crowd` puts those that follow their motion where it is, and lets
people who react walk on. These are driven by the social force model of D. Helbing and P. Molnar,
"Social force model for pedestrian dynamics", Physical Review E 51 (1995): each adapts its velocity
to the way that it wants to go, and is pushed away from others by an exponential potential, whose
equipotential lines are ellipses along the other's next steps. These steps are relative to one's
own, as in A. Johansson, D. Helbing and P. Shukla, "Specification of the social force pedestrian
model by evolutionary adjustment to video tracking data", Advances in Complex Systems 10 (2007), so
that people begin to walk around what stands before they are there. Walls push as in D. Helbing,
I. Farkas and T. Vicsek, "Simulating dynamical features of escape panic", Nature 407 (2000), whose
range lets people through doors. A person decides anew every REACTION_TIME, and walks on in between.

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
STRIDE_TIME = 1.0  # the push's ellipse reaches along the other's relative way of so long [s]
SIDESTEP = 0.2
"""People turn the push of others so much to their right: two who meet head-on would stop, or walk
through each other [rad]."""
WALL_PUSH = 25.0  # push of a wall that a person touches [m/s^2]
WALL_RANGE = 0.08  # range of that push [m]
FARTHEST_WALL = 8.0 * WALL_RANGE  # walls that are farther away don't push [m]
SIGHT_COSINE = math.cos(math.radians(100.0))  # others beyond this bearing are behind a person
BEHIND_SHARE = 0.5  # share of the push of others that are behind
SPEED_SHARE = 1.3  # greatest speed, in parts of that of the motion
MOST_PUSH = 10.0  # greatest acceleration [m/s^2]
LONGEST_LOOK = 1.0  # a mover that is far away is looked at so often, at least [s]
FARTHEST_PUSH = 6.0  # others that are farther away don't push [m]
SIGHT_RESOLUTION = 2.0**-20
"""People see where the robot is and how it moves to this, a micrometre [m, m/s].

Crowds are chaotic: without it the last bit of a pose, in which one robot and a batch differ,
changes them in 20 s."""
LOOKAHEAD_TIME = 0.5  # a person walks to where the motion will be in this time [s]
LEASH = 1.0  # the motion waits for a person who is so far behind [m]
PERSONAL_SPACE = 0.45
"""Distance between two hulls within which a person feels intruded upon [m]: the farther limit of
the intimate distance in E. T. Hall, "The Hidden Dimension" (1966)."""
STANDING_SPEED = 0.05
"""A robot that comes nearer to a person by no more than this hasn't run into it [m/s]."""
FARTHEST_PERSON = 100.0  # distances to the nearest mover are at most this [m]
FARTHEST_COLLISION = 10.0  # times to collision are at most this [s]

X, Y, VX, VY, CLOCK, AX, AY, PACE, NEAR, LOOK = range(10)
STATE_NUMBERS = 10
"""Columns of the state of a mover: place [m], velocity [m/s], the time of its motion, at the
episode's begin or, of a person who reacts, now [s], that person's acceleration [m/s^2], how fast
the motion's time passes for that person, whether the robot is within its personal space, and the
next tick in which that can change."""
SEEN_NUMBERS = 5
"""Columns of what is seen of a mover: place [m], velocity [m/s], radius [m]."""
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


class Hall(NamedTuple):
    """What surrounds the movers of an episode."""

    movers: Floats
    """(movers, numbers): of the world, see `Motions`."""
    pieces: Floats
    """(pieces, 9): of the world."""
    is_reacting: bool
    """Whether anybody reacts."""
    key: float
    """The episode's draw, 0 to 1."""
    period: float
    """Of a tick [s]."""
    which: int
    """The world's place in `around`."""
    around: Surroundings
    """Obstacles, and footprints."""
    kind: int
    """Of the robot, whose footprint it is."""


@jit
def disc_radius(hall: Hall) -> float:
    """Radius of the disc around the robot's footprint [m]."""
    kinds, kind = hall.around.kinds, hall.kind
    return math.sqrt(kinds[kind, 5] * kinds[kind, 5] + kinds[kind, 6] * kinds[kind, 6])


@subroutine
def begin_crowd(movers: Floats, pieces: Floats, states: Floats, key: float) -> None:
    """Put all movers where an episode begins."""
    for m in range(len(movers)):
        if movers[m, RADIUS] < 0.0:
            break
        for k in range(STATE_NUMBERS):
            states[m, k] = 0.0
        states[m, CLOCK] = draw_offset(movers, m, key)
        place_mover(movers, m, pieces, states, 0.0)


@jit
def place_mover(movers: Floats, m: int, pieces: Floats, states: Floats, time: float) -> None:
    """Put a mover that doesn't react where its motion is at a time since the episode's begin."""
    x, y, vx, vy = locate_mover(movers, m, pieces, time + states[m, CLOCK])
    states[m, X], states[m, Y], states[m, VX], states[m, VY] = x, y, vx, vy


@subroutine
def place_crowd(movers: Floats, pieces: Floats, states: Floats, time: float) -> None:
    """Put all movers that don't react where they are at a time since the episode's begin [s]."""
    for m in range(len(movers)):
        if movers[m, RADIUS] < 0.0:
            break
        if movers[m, REACTS] == 0.0:
            place_mover(movers, m, pieces, states, time)


@subroutine
def advance_crowd(
    hall: Hall, states: Floats, tick: int, robot: RobotMotion, top_speed: float
) -> tuple[float, float, float]:
    """Advance all movers of a robot's world to the end of a tick, and look for contacts.

    Args:
        hall: of the episode.
        states: (movers, STATE_NUMBERS): they change.
        tick: its number since the episode's begin, from 1.
        robot: at the end of the tick.
        top_speed: no part of the robot will move faster [m/s]. Movers that follow their motion and
            can't touch it, or come near, in the next ticks stay where they are until
            `place_crowd`. inf: all are moved.

    Returns:
        Whether somebody ran into somebody, such as ROBOT_HIT, how often the robot has entered
        somebody's personal space, and the next tick in which this has to be called.
    """
    if hall.is_reacting:
        walk_crowd(hall, states, tick, robot)
    outer, longest = disc_radius(hall), LONGEST_LOOK / hall.period
    hit, entered, next_look = NO_HIT, 0.0, tick + 1.0 if hall.is_reacting else np.inf
    for m in range(len(hall.movers)):
        if hall.movers[m, RADIUS] < 0.0:
            break
        if tick >= states[m, LOOK]:
            if hall.movers[m, REACTS] == 0.0:
                place_mover(hall.movers, m, hall.pieces, states, tick * hall.period)
            was_near = states[m, NEAR]
            free, touches = look_at_mover(hall, states, m, robot, outer)
            entered += 1.0 if states[m, NEAR] > was_near else 0.0
            hit = touches if hit == NO_HIT else hit
            fastest = (top_speed + SPEED_SHARE * hall.movers[m, SPEED]) * hall.period
            now = tick * hall.period + states[m, CLOCK]
            jumps = may_jump(hall.movers, m, now, LONGEST_LOOK)
            ticks = 1.0 if jumps else min(np.floor(free / fastest), longest)
            states[m, LOOK] = tick + max(ticks, 1.0)
        next_look = min(next_look, states[m, LOOK])
    return hit, entered, next_look


@jit
def look_at_mover(
    hall: Hall, states: Floats, m: int, robot: RobotMotion, outer: float
) -> tuple[float, float]:
    """Set whether the robot is in a mover's personal space.

    Returns:
        By how much the two hulls can change their distance until that, or a contact, begins or ends
        [m], and whether they touch, such as ROBOT_HIT.
    """
    dx, dy = states[m, X] - robot.x, states[m, Y] - robot.y
    near, square = outer + hall.movers[m, RADIUS] + PERSONAL_SPACE, dx * dx + dy * dy
    if square > near * near:
        states[m, NEAR] = 0.0
        return math.sqrt(square) - near, NO_HIT
    ahead, left = robot.cos * dx + robot.sin * dy, robot.cos * dy - robot.sin * dx
    gap, at_x, at_y = footprint_gap(ahead, left, hall.around, hall.kind)
    gap -= hall.movers[m, RADIUS]
    states[m, NEAR] = 1.0 if gap < PERSONAL_SPACE else 0.0
    if gap > 0.0:
        return min(gap, abs(gap - PERSONAL_SPACE)), NO_HIT
    return 0.0, ROBOT_HIT if comes_nearer(ahead, left, at_x, at_y, robot) else PERSON_HIT


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
def walk_crowd(hall: Hall, states: Floats, tick: int, robot: RobotMotion) -> None:
    """Let people who react walk for a tick; every REACTION_TIME all decide anew how."""
    every = max(int(np.floor(REACTION_TIME / hall.period + 0.5)), 1)
    if (tick - 1) % every == 0:
        place_crowd(hall.movers, hall.pieces, states, tick * hall.period)
        seen = RobotMotion(
            round_seen(robot.x),
            round_seen(robot.y),
            round_seen(robot.cos),
            round_seen(robot.sin),
            round_seen(robot.forward),
            round_seen(robot.rate),
        )
        for m in range(len(hall.movers)):
            if hall.movers[m, REACTS] > 0.0:
                decide_step(hall, states, m, seen)
    for m in range(len(hall.movers)):
        if hall.movers[m, REACTS] > 0.0:
            walk_on(hall.movers, m, states, hall.period)


@jit
def round_seen(number: float) -> float:
    """A number as people see it, see `SIGHT_RESOLUTION`."""
    seen: float = np.rint(number / SIGHT_RESOLUTION) * SIGHT_RESOLUTION
    return seen


@subroutine
def decide_step(hall: Hall, states: Floats, m: int, robot: RobotMotion) -> None:
    """Set the acceleration of person m, and the pace of its motion, until the next decision."""
    movers, x, y = hall.movers, states[m, X], states[m, Y]
    now_x, now_y, now_vx, now_vy = locate_mover(movers, m, hall.pieces, states[m, CLOCK])
    off_x, off_y = now_x - x, now_y - y
    is_behind = off_x * now_vx + off_y * now_vy > 0.0
    behind = math.sqrt(off_x * off_x + off_y * off_y) if is_behind else 0.0
    states[m, PACE] = max(1.0 - behind / LEASH, 0.0)
    clock = states[m, CLOCK] + LOOKAHEAD_TIME
    to_x, to_y, _, _ = locate_mover(movers, m, hall.pieces, clock)
    want_x, want_y = (to_x - x) / LOOKAHEAD_TIME, (to_y - y) / LOOKAHEAD_TIME
    speed, most = math.sqrt(want_x * want_x + want_y * want_y), SPEED_SHARE * movers[m, SPEED]
    share = most / speed if speed > most else 1.0
    want_x, want_y = share * want_x, share * want_y
    relaxation = draw_trait(hall.key, m, 0, RELAXATION_TIMES[0], RELAXATION_TIMES[1])
    others_x, others_y = push_from_others(hall, states, m, robot, want_x, want_y)
    walls_x, walls_y = push_from_walls(hall, x, y, movers[m, RADIUS])
    ax = (want_x - states[m, VX]) / relaxation + others_x + walls_x
    ay = (want_y - states[m, VY]) / relaxation + others_y + walls_y
    push = math.sqrt(ax * ax + ay * ay)
    share = MOST_PUSH / push if push > MOST_PUSH else 1.0
    states[m, AX], states[m, AY] = share * ax, share * ay


@jit
def push_from_others(
    hall: Hall, states: Floats, m: int, robot: RobotMotion, want_x: float, want_y: float
) -> tuple[float, float]:
    """Push on person m from other movers, and from the robot where it is seen [m/s^2].

    `want_x`, `want_y` is the velocity that the person wants [m/s], and the direction of its look.
    """
    movers, count = hall.movers, len(hall.movers)
    speed = math.sqrt(want_x * want_x + want_y * want_y)
    strength = draw_trait(hall.key, m, 1, STRENGTHS[0], STRENGTHS[1])
    total_x = total_y = 0.0
    for n in range(count + 1):
        if n == count:
            is_pushing, x, y = movers[m, SEES_ROBOT] > 0.0, robot.x, robot.y
            vx, vy, radius = robot.forward * robot.cos, robot.forward * robot.sin, disc_radius(hall)
        else:
            is_pushing, x, y = n != m and movers[n, RADIUS] > 0.0, states[n, X], states[n, Y]
            vx, vy, radius = states[n, VX], states[n, VY], movers[n, RADIUS]
        dx, dy = states[m, X] - x, states[m, Y] - y
        square = dx * dx + dy * dy
        if not is_pushing or square > FARTHEST_PUSH * FARTHEST_PUSH:
            continue
        vx, vy = vx - states[m, VX], vy - states[m, VY]
        push_x, push_y = push_away(dx, dy, vx, vy, movers[m, RADIUS] + radius, strength)
        seen = -(want_x * dx + want_y * dy) >= SIGHT_COSINE * speed * math.sqrt(square)
        share = 1.0 if seen else BEHIND_SHARE
        total_x, total_y = total_x + share * push_x, total_y + share * push_y
    cos, sin = math.cos(SIDESTEP), math.sin(SIDESTEP)
    return cos * total_x - sin * total_y, sin * total_x + cos * total_y


@jit
def push_from_walls(hall: Hall, x: float, y: float, radius: float) -> tuple[float, float]:
    """Push on a person at (x, y) from standing obstacles [m/s^2]."""
    circles, segments, which = hall.around.circles, hall.around.segments, hall.which
    far, total_x, total_y = radius + FARTHEST_WALL, 0.0, 0.0
    for n in range(circles.shape[1]):
        dx, dy = x - circles[which, n, 0], y - circles[which, n, 1]
        reach, square = far + circles[which, n, 2], dx * dx + dy * dy
        if square < reach * reach:
            apart = math.sqrt(square) + 1e-9
            push = WALL_PUSH * math.exp((radius + circles[which, n, 2] - apart) / WALL_RANGE)
            total_x, total_y = total_x + push * dx / apart, total_y + push * dy / apart
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
            total_x, total_y = total_x + push * dx / apart, total_y + push * dy / apart
    return total_x, total_y


@jit
def push_away(
    dx: float, dy: float, vx: float, vy: float, both: float, strength: float
) -> tuple[float, float]:
    """Push [m/s^2] on a person at (dx, dy) from another one, whose relative velocity is (vx, vy).

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
def walk_on(movers: Floats, m: int, states: Floats, period: float) -> None:
    """Let a person who reacts walk for a tick as decided."""
    vx, vy = states[m, VX] + states[m, AX] * period, states[m, VY] + states[m, AY] * period
    speed, most = math.sqrt(vx * vx + vy * vy), SPEED_SHARE * movers[m, SPEED]
    share = most / speed if speed > most else 1.0
    states[m, VX], states[m, VY] = share * vx, share * vy
    states[m, X] += states[m, VX] * period
    states[m, Y] += states[m, VY] * period
    states[m, CLOCK] += states[m, PACE] * period


@subroutine
def survey_crowd(hall: Hall, states: Floats, robot: RobotMotion) -> tuple[float, float]:
    """Measure how near the robot is to movers.

    Returns:
        Distance from its hull to the nearest one's [m], 0 to FARTHEST_PERSON, and the time until
        its disc would touch one if all kept their velocities [s], at most FARTHEST_COLLISION.
    """
    nearest, soonest = FARTHEST_PERSON, FARTHEST_COLLISION
    outer = disc_radius(hall)
    for m in range(len(hall.movers)):
        radius = hall.movers[m, RADIUS]
        if radius < 0.0:
            break
        dx, dy = states[m, X] - robot.x, states[m, Y] - robot.y
        reach = nearest + outer + radius
        if dx * dx + dy * dy < reach * reach:
            ahead, left = robot.cos * dx + robot.sin * dy, robot.cos * dy - robot.sin * dx
            gap, _, _ = footprint_gap(ahead, left, hall.around, hall.kind)
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


@jit
def hall_alone(motions: Motions, key: float, period: float, around: Surroundings) -> Hall:
    """The hall of one robot."""
    world = motions.movers[0], motions.pieces[0], motions.reacting[0]
    return Hall(world[0], world[1], world[2], key, period, 0, around, 0)


@loop
def advance_alone(
    motions: Motions,
    around: Surroundings,
    key: float,
    period: float,
    states: Floats,
    tick: int,
    pose: Pose,
    twist: Twist,
) -> tuple[float, float, float]:
    """`advance_crowd` for one robot."""
    robot = RobotMotion(pose[0], pose[1], math.cos(pose[2]), math.sin(pose[2]), *twist)
    hall = hall_alone(motions, key, period, around)
    return advance_crowd(hall, states, tick, robot, np.inf)


@loop
def survey_alone(
    motions: Motions, around: Surroundings, states: Floats, pose: Pose, twist: Twist
) -> tuple[float, float]:
    """`survey_crowd` for one robot."""
    robot = RobotMotion(pose[0], pose[1], math.cos(pose[2]), math.sin(pose[2]), *twist)
    return survey_crowd(hall_alone(motions, 0.0, 0.0, around), states, robot)


class Crowd:
    """The movers around one simulated robot, in one episode.

    Attributes: `motions`, of this world alone; `radii`, (movers,) [m]; `states`, (movers,
    STATE_NUMBERS); `hit`, the first contact, such as ROBOT_HIT; `intrusions`, how often the robot
    has entered somebody's personal space.
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

    @property
    def now(self) -> float:
        """Time since the episode's begin [s]."""
        return self._tick * self._period

    def advance(self, pose: Pose, twist: Twist) -> None:
        """Advance by a control period, at whose end the robot is there and moves so."""
        self._tick += 1
        episode = self.motions, self._around, self._key, self._period, self.states
        hit, entered, _ = advance_alone(*episode, self._tick, pose, twist)
        self.hit = self.hit or hit
        self.intrusions += entered

    def survey(self, pose: Pose, twist: Twist) -> tuple[float, float]:
        """Distance of the nearest mover [m] and time to collision [s], see `survey_crowd`."""
        return survey_alone(self.motions, self._around, self.states, pose, twist)

    def copy_states(self) -> Floats:
        """Copy what is seen of the movers now, (movers, SEEN_NUMBERS), in the world's frame."""
        return np.column_stack([self.states[:, :CLOCK], self.radii])
