"""What movers do in an episode: where they are, whom they keep away from, and whom they touch.

Once a control period `advance_crowd` puts those that follow their motion where it is, and lets
people who react walk on. These are driven by the social force model of D. Helbing and P. Molnar,
"Social force model for pedestrian dynamics", Physical Review E 51 (1995): each adapts its velocity
to the way that it wants to go, and is pushed away from others by an exponential potential, whose
equipotential lines are ellipses along the other's next steps. These steps are relative to the
person's steps, as in A. Johansson, D. Helbing and P. Shukla, "Specification of the social force
pedestrian model by evolutionary adjustment to video tracking data", Advances in Complex Systems 10
(2007), so that people start to walk around an obstacle before they are there. Walls push as in D.
Helbing, I. Farkas and T. Vicsek, "Simulating dynamical features of escape panic", Nature 407
(2000), whose range lets people through doors. A person decides again every REACTION_TIME, and walks
on in between.

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
    Surroundings,
    footprint_gap,
    length_of,
    line_at,
    make_surroundings,
    offset_from,
    outer_radius,
    share_along,
    turn_back,
)
from acsar_gym.worlds.movers import (
    RADIUS,
    REACTS,
    SEES_ROBOT,
    SPEED,
    draw_offset,
    locate_mover,
    make_motions,
    may_jump,
)
from acsar_gym.worlds.world import RADIUS as CIRCLE_RADIUS
from acsar_gym.worlds.world import Pose, World

Floats = NDArray[np.float64]
REACTION_TIME = 0.1  # interval between two decisions of a person who reacts [s]
RELAXATION_TIMES = (0.4, 0.6)
"""In about this time a person's velocity becomes the wanted one, drawn for each [s]. Published:
0.5."""
STRENGTHS = (1.5, 2.7)
"""Strength of the push of others, drawn for each [m^2/s^2]. Published: 2.1."""
PUSH_RANGE = 0.3  # range of that push [m]
STRIDE_TIME = 1.0  # the push's ellipse reaches along the other's relative way of this time [s]
SIDESTEP = 0.2
"""People turn the push of others by this angle to their right [rad]: two who meet head-on would
stop, or walk through each other."""
WALL_PUSH = 25.0  # push of a wall that a person touches [m/s^2]
WALL_RANGE = 0.08  # range of that push [m]
FARTHEST_WALL = 8.0 * WALL_RANGE  # walls that are farther away don't push [m]
SIGHT_COSINE = math.cos(math.radians(100.0))  # others beyond this bearing are behind a person
BEHIND_SHARE = 0.5  # share of the push of others that are behind
SPEED_SHARE = 1.3  # greatest speed, in parts of that of the motion
MOST_PUSH = 10.0  # greatest acceleration [m/s^2]
LONGEST_LOOK = 1.0  # a mover that is far away is looked at with at most this interval [s]
FARTHEST_PUSH = 6.0  # others that are farther away don't push [m]
SIGHT_RESOLUTION = 2.0**-20
"""People see where the robot is and how it moves to this, a micrometre [m, m/s].

Crowds are chaotic: without it the last bit of a pose, in which one robot and a batch differ,
changes them in 20 s."""
LOOKAHEAD_TIME = 0.5  # a person walks to where the motion will be in this time [s]
LEASH = 1.0  # the motion waits for a person who is this far behind [m]
PERSONAL_SPACE = 0.45
"""Distance between two hulls within which a person feels intruded upon [m]: the farther limit of
the intimate distance in E. T. Hall, "The Hidden Dimension" (1966)."""
STANDING_SPEED = 0.05
"""A robot that comes nearer to a person by no more than this hasn't run into it [m/s]."""
FARTHEST_PERSON = 100.0  # distances to the nearest mover are at most this [m]
FARTHEST_COLLISION = 10.0  # times to collision are at most this [s]
TRAITS = 1000  # first sample of people's traits
TRAIT_NUMBERS = 2  # traits of each person
NO_HIT = 0.0
ROBOT_HIT = 1.0
PERSON_HIT = 2.0
"""What `advance_crowd` reports of contacts: none, the robot ran into a mover, or a mover into
it."""

Point = tuple[float, float]
Twist = tuple[float, float]  # forward speed [m/s], yaw rate [rad/s]

X, Y, VX, VY, CLOCK, AX, AY, PACE, NEAR, LOOK = range(10)
"""Columns of the state of a mover: place [m] and velocity [m/s], then CLOCK, the time of its motion
[s]: at the start of the episode, or now for a person who reacts. AX and AY are the acceleration of
a person who reacts [m/s^2], PACE is how fast its motion's time passes, NEAR whether the robot is
within its personal space, LOOK the next tick in which that can change."""
STATE_NUMBERS = 10
SEEN_NUMBERS = 5
"""Columns of what is seen of a mover: place [m], velocity [m/s], radius [m]."""


class RobotMotion(NamedTuple):
    """Where a robot is in the frame of the world, and how it moves [m, m/s, rad/s]."""

    x: float
    y: float
    cos: float
    sin: float
    forward: float
    rate: float


class Disc(NamedTuple):
    """What people see of another person or of the robot [m, m/s]."""

    x: float
    y: float
    vx: float
    vy: float
    radius: float


class Hall(NamedTuple):
    """What surrounds the movers of an episode."""

    movers: Floats
    """(movers, numbers): of the world, see `Motions`."""
    pieces: Floats
    """(pieces, 9): of the world."""
    is_reacting: bool
    """Whether a mover reacts."""
    key: float
    """The episode's draw, 0 to 1."""
    period: float
    """Duration of a tick [s]."""
    which: int
    """The world's place in `around`."""
    around: Surroundings
    """Obstacles, and footprints."""
    kind: int
    """Kind of the robot, which selects the footprint."""


@subroutine
def begin_crowd(hall: Hall, states: Floats) -> None:
    """Put all movers where they are when an episode starts."""
    states[:] = 0.0
    for m in range(len(hall.movers)):
        if hall.movers[m, RADIUS] > 0.0:
            states[m, CLOCK] = draw_offset(hall.movers[m], m, hall.key)
            place_mover(hall, states, m, time=0.0)


@jit
def place_mover(hall: Hall, states: Floats, m: int, time: float) -> None:
    """Put mover m where its motion is at a time since the start of the episode."""
    x, y, vx, vy = locate_mover(hall.movers[m], hall.pieces, time + states[m, CLOCK])
    states[m, X] = x
    states[m, Y] = y
    states[m, VX] = vx
    states[m, VY] = vy


@subroutine
def place_crowd(hall: Hall, states: Floats, time: float) -> None:
    """Put all movers that don't react where they are at a time since the start of the episode."""
    for m in range(len(states)):
        if hall.movers[m, RADIUS] > 0.0 and hall.movers[m, REACTS] == 0.0:
            place_mover(hall, states, m, time=time)


@subroutine
def advance_crowd(
    hall: Hall, states: Floats, tick: int, robot: RobotMotion, top_speed: float
) -> tuple[float, float, float]:
    """Advance all movers of a robot's world to the end of a tick, and look for contacts.

    Args:
        hall: What surrounds them.
        states: (movers, STATE_NUMBERS): their states, which change.
        tick: Number of the tick since the start of the episode, from 1.
        robot: The robot at the end of the tick.
        top_speed: No part of the robot will move faster [m/s]. Movers that follow their motion and
            can't touch it, or come near, in the next ticks stay where they are until
            `place_crowd`. With infinity all are moved.

    Returns:
        A contact, such as ROBOT_HIT, how often the robot has entered a mover's personal space, and
        the next tick in which this has to be called.
    """
    if hall.is_reacting:
        walk_crowd(hall, states, tick, robot)

    hit = NO_HIT
    entered = 0.0
    next_look = tick + 1.0 if hall.is_reacting else np.inf
    for m in range(len(states)):
        if hall.movers[m, RADIUS] < 0.0:
            break
        if tick >= states[m, LOOK]:
            if hall.movers[m, REACTS] == 0.0:
                place_mover(hall, states, m, time=tick * hall.period)
            was_near = states[m, NEAR]
            free, contact = look_at_mover(hall, states, m, robot)
            entered += 1.0 if states[m, NEAR] > was_near else 0.0
            hit = contact if hit == NO_HIT else hit

            # Neither a contact nor an intrusion can change until both have come this far.
            fastest = (top_speed + SPEED_SHARE * hall.movers[m, SPEED]) * hall.period
            now = tick * hall.period + states[m, CLOCK]
            jumps = may_jump(hall.movers[m], now, LONGEST_LOOK)
            ticks = 1.0 if jumps else min(np.floor(free / fastest), LONGEST_LOOK / hall.period)
            states[m, LOOK] = tick + max(ticks, 1.0)
        next_look = min(next_look, states[m, LOOK])
    return hit, entered, next_look


@jit
def look_at_mover(hall: Hall, states: Floats, m: int, robot: RobotMotion) -> Point:
    """Set whether the robot is in the personal space of mover m.

    Returns:
        The change of distance between the two hulls until that, or a contact, can start or end [m],
        and whether they touch, such as ROBOT_HIT.
    """
    radius = hall.movers[m, RADIUS]
    dx = states[m, X] - robot.x
    dy = states[m, Y] - robot.y
    # By circles first, because the exact hull takes longer.
    near = outer_radius(hall.around, hall.kind) + radius + PERSONAL_SPACE
    square = dx * dx + dy * dy
    if square > near * near:
        states[m, NEAR] = 0.0
        return math.sqrt(square) - near, NO_HIT

    ahead, aside = turn_back(dx, dy, robot.cos, robot.sin)
    gap, at_x, at_y = footprint_gap(ahead, aside, hall.around, hall.kind)
    gap -= radius
    states[m, NEAR] = 1.0 if gap < PERSONAL_SPACE else 0.0
    if gap > 0.0:
        return min(gap, abs(gap - PERSONAL_SPACE)), NO_HIT
    return 0.0, ROBOT_HIT if comes_nearer(ahead, aside, at_x, at_y, robot=robot) else PERSON_HIT


@jit
def comes_nearer(ahead: float, aside: float, at_x: float, at_y: float, robot: RobotMotion) -> bool:
    """Whether the place (at_x, at_y) of a robot's hull moves towards a mover, in the base frame."""
    dx = ahead - at_x
    dy = aside - at_y
    distance = length_of(dx, dy)
    if distance < 1e-9:  # the mover's middle is within the hull: seen from the robot's middle
        dx = ahead
        dy = aside
        distance = length_of(dx, dy) + 1e-12
    # The velocity of this place of the hull, along the line to the mover.
    approach = (robot.forward - robot.rate * at_y) * dx + robot.rate * at_x * dy
    return approach > STANDING_SPEED * distance


# People who react


@subroutine
def walk_crowd(hall: Hall, states: Floats, tick: int, robot: RobotMotion) -> None:
    """Let people who react walk for a tick, and decide how every REACTION_TIME."""
    # Decisions take most of the time, and people don't decide a hundred times a second.
    interval = max(int(np.floor(REACTION_TIME / hall.period + 0.5)), 1)
    if (tick - 1) % interval == 0:
        place_crowd(hall, states, tick * hall.period)
        visible = see_robot(hall, robot)
        for m in range(len(states)):
            if hall.movers[m, REACTS] > 0.0:
                decide_step(hall, states, m, visible)

    for m in range(len(states)):
        if hall.movers[m, REACTS] > 0.0:
            walk_on(hall, states, m)


@jit
def see_robot(hall: Hall, robot: RobotMotion) -> Disc:
    """The robot as people see it."""
    forward = round_seen(robot.forward)
    return Disc(
        x=round_seen(robot.x),
        y=round_seen(robot.y),
        vx=forward * round_seen(robot.cos),
        vy=forward * round_seen(robot.sin),
        radius=outer_radius(hall.around, hall.kind),
    )


@jit
def see_mover(hall: Hall, states: Floats, m: int) -> Disc:
    """Mover m as others see it."""
    return Disc(
        x=states[m, X],
        y=states[m, Y],
        vx=states[m, VX],
        vy=states[m, VY],
        radius=hall.movers[m, RADIUS],
    )


@jit
def round_seen(number: float) -> float:
    """A number as people see it, see `SIGHT_RESOLUTION`."""
    rounded: float = np.rint(number / SIGHT_RESOLUTION) * SIGHT_RESOLUTION
    return rounded


@jit
def draw_trait(key: float, mover: int, number: int, limits: tuple[float, float]) -> float:
    """Draw a trait of a person, the same in the whole episode, between two limits."""
    sample = hash_sample(key, TRAITS + mover * TRAIT_NUMBERS + number)
    return limits[0] + (limits[1] - limits[0]) * sample


@jit
def limit_length(x: float, y: float, longest: float) -> Point:
    """Shorten a vector that is longer than a limit."""
    length = length_of(x, y)
    share = longest / length if length > longest else 1.0
    return share * x, share * y


@subroutine
def decide_step(hall: Hall, states: Floats, m: int, robot: Disc) -> None:
    """Set the acceleration of person m, and the pace of its motion, until the next decision."""
    mover = hall.movers[m]
    person = see_mover(hall, states, m)
    clock = states[m, CLOCK]

    # The motion waits for a person who is behind.
    goal_x, goal_y, goal_vx, goal_vy = locate_mover(mover, hall.pieces, clock)
    off_x = goal_x - person.x
    off_y = goal_y - person.y
    is_behind = off_x * goal_vx + off_y * goal_vy > 0.0
    behind = length_of(off_x, off_y) if is_behind else 0.0
    states[m, PACE] = max(1.0 - behind / LEASH, 0.0)

    # The wanted velocity leads to where the motion will be.
    to_x, to_y, _, _ = locate_mover(mover, hall.pieces, clock + LOOKAHEAD_TIME)
    want = limit_length(
        (to_x - person.x) / LOOKAHEAD_TIME,
        (to_y - person.y) / LOOKAHEAD_TIME,
        SPEED_SHARE * mover[SPEED],
    )

    relaxation = draw_trait(hall.key, m, 0, limits=RELAXATION_TIMES)
    crowd = push_from_others(hall, states, m, robot, want)
    walls = push_from_walls(hall, person)
    ax = (want[0] - person.vx) / relaxation + crowd[0] + walls[0]
    ay = (want[1] - person.vy) / relaxation + crowd[1] + walls[1]
    states[m, AX], states[m, AY] = limit_length(ax, ay, MOST_PUSH)


@jit
def push_from_others(hall: Hall, states: Floats, m: int, robot: Disc, want: Point) -> Point:
    """Push on person m from other movers, and from the robot if the person sees it [m/s^2].

    `want` is the velocity that the person wants [m/s], and the direction of its look.
    """
    strength = draw_trait(hall.key, m, 1, limits=STRENGTHS)
    person = see_mover(hall, states, m)
    total_x = 0.0
    total_y = 0.0
    for n in range(len(states)):
        if n != m and hall.movers[n, RADIUS] > 0.0:
            push_x, push_y = push_from(see_mover(hall, states, n), person, want, strength)
            total_x += push_x
            total_y += push_y
    if hall.movers[m, SEES_ROBOT] > 0.0:
        push_x, push_y = push_from(robot, person, want, strength)
        total_x += push_x
        total_y += push_y

    cos = math.cos(SIDESTEP)
    sin = math.sin(SIDESTEP)
    return cos * total_x - sin * total_y, sin * total_x + cos * total_y


@subroutine
def push_from(other: Disc, person: Disc, want: Point, strength: float) -> Point:
    """Push of another disc on a person [m/s^2].

    The potential is strength * exp(-(b - radii) / PUSH_RANGE), b being the semi-minor axis of the
    ellipse, and `radii` those of the two, which the published potential leaves out.
    """
    dx = person.x - other.x
    dy = person.y - other.y
    straight = length_of(dx, dy)
    if straight > FARTHEST_PUSH:
        return 0.0, 0.0

    stride_x = STRIDE_TIME * (other.vx - person.vx)
    stride_y = STRIDE_TIME * (other.vy - person.vy)
    later_x = dx - stride_x
    later_y = dy - stride_y
    distance = straight + 1e-9
    later = length_of(later_x, later_y) + 1e-9
    total = distance + later
    stride = stride_x * stride_x + stride_y * stride_y
    axis = 0.5 * math.sqrt(max(total * total - stride, 1e-6))
    radii = person.radius + other.radius
    force = strength / PUSH_RANGE * math.exp(min((radii - axis) / PUSH_RANGE, 2.0))
    force *= total / (4.0 * axis)

    speed = length_of(want[0], want[1])
    is_ahead = -(want[0] * dx + want[1] * dy) >= SIGHT_COSINE * speed * straight
    share = 1.0 if is_ahead else BEHIND_SHARE
    push_x = share * (force * (dx / distance + later_x / later))
    return push_x, share * (force * (dy / distance + later_y / later))


@jit
def push_from_walls(hall: Hall, person: Disc) -> Point:
    """Push on a person from standing obstacles [m/s^2]."""
    total_x = 0.0
    total_y = 0.0
    circles = hall.around.circles
    for n in range(circles.shape[1]):
        dx = person.x - circles[hall.which, n, X]
        dy = person.y - circles[hall.which, n, Y]
        reach = person.radius + circles[hall.which, n, CIRCLE_RADIUS]
        push_x, push_y = push_from_wall(dx, dy, reach)
        total_x += push_x
        total_y += push_y

    for n in range(hall.around.segments.shape[1]):
        wall = line_at(hall.around.segments, hall.which, n)
        share = share_along(person.x, person.y, wall)
        dx, dy = offset_from(person.x, person.y, wall, share)
        push_x, push_y = push_from_wall(dx, dy, person.radius)
        total_x += push_x
        total_y += push_y
    return total_x, total_y


@jit
def push_from_wall(dx: float, dy: float, reach: float) -> Point:
    """Push of a wall, which is in touch at a distance of `reach`, from its place [m/s^2]."""
    square = dx * dx + dy * dy
    if square < (reach + FARTHEST_WALL) ** 2:
        distance = math.sqrt(square) + 1e-9
        force = WALL_PUSH * math.exp((reach - distance) / WALL_RANGE)
        return force * dx / distance, force * dy / distance
    return 0.0, 0.0


@subroutine
def walk_on(hall: Hall, states: Floats, m: int) -> None:
    """Let person m, who reacts, walk for a tick as decided."""
    period = hall.period
    # As for a body with a mass: acceleration, velocity, place.
    vx, vy = limit_length(
        states[m, VX] + states[m, AX] * period,
        states[m, VY] + states[m, AY] * period,
        SPEED_SHARE * hall.movers[m, SPEED],
    )
    states[m, VX] = vx
    states[m, VY] = vy
    states[m, X] += vx * period
    states[m, Y] += vy * period
    states[m, CLOCK] += states[m, PACE] * period


# What is measured


@subroutine
def survey_crowd(hall: Hall, states: Floats, robot: RobotMotion) -> Point:
    """Measure how near the robot is to movers.

    Returns:
        Distance from its hull to that of the nearest mover [m], 0 to FARTHEST_PERSON, and the time
        until its disc would touch a mover if all kept their velocities [s], at most
        FARTHEST_COLLISION.
    """
    nearest = FARTHEST_PERSON
    soonest = FARTHEST_COLLISION
    outer = outer_radius(hall.around, hall.kind)
    for m in range(len(states)):
        radius = hall.movers[m, RADIUS]
        if radius < 0.0:
            break

        dx = states[m, X] - robot.x
        dy = states[m, Y] - robot.y
        # Only a mover that may be nearer than the nearest so far is measured exactly.
        reach = nearest + outer + radius
        if dx * dx + dy * dy < reach * reach:
            ahead, aside = turn_back(dx, dy, robot.cos, robot.sin)
            gap, _, _ = footprint_gap(ahead, aside, hall.around, hall.kind)
            nearest = min(nearest, max(gap - radius, 0.0))
        vx = states[m, VX] - robot.forward * robot.cos
        vy = states[m, VY] - robot.forward * robot.sin
        soonest = min(soonest, time_to_touch(dx, dy, vx, vy, radii=outer + radius))
    return nearest, soonest


@jit
def time_to_touch(dx: float, dy: float, vx: float, vy: float, radii: float) -> float:
    """Time until two discs touch that keep their velocities [s], or infinity if they never do.

    `dx`, `dy` is the place and `vx`, `vy` the velocity of a disc from the other disc, `radii` the
    sum of their radii [m, m/s].
    """
    square = vx * vx + vy * vy
    along = dx * vx + dy * vy
    outside = dx * dx + dy * dy - radii * radii
    if outside <= 0.0:
        return 0.0
    inside = along * along - square * outside
    if along >= 0.0 or inside < 0.0:
        return np.inf
    return outside / (math.sqrt(inside) - along)


# The crowd of one robot

_begin = loop(begin_crowd)
_advance = loop(advance_crowd)
_survey = loop(survey_crowd)


def motion_of(pose: Pose, twist: Twist) -> RobotMotion:
    """The motion of a robot."""
    x, y, theta = pose
    return RobotMotion(x, y, math.cos(theta), sin=math.sin(theta), forward=twist[0], rate=twist[1])


class Crowd:
    """The movers around one simulated robot, in one episode.

    Args:
        world: World with the movers.
        config: Configuration of the robot.
        key: The episode's draw, 0 to 1, see `Scene.key`.

    Attributes:
        motions: Motions of the movers of this world.
        hall: What surrounds them.
        radii: (movers,): their radii [m].
        states: (movers, STATE_NUMBERS): their states, see `X`.
        hit: The first contact, such as ROBOT_HIT.
        intrusions: How often the robot has entered a mover's personal space.
    """

    def __init__(self, world: World, config: RobotConfig, key: float) -> None:
        self.motions = make_motions([world.movers])
        self.hall = Hall(
            movers=self.motions.movers[0],
            pieces=self.motions.pieces[0],
            is_reacting=bool(self.motions.reacting[0]),
            key=key,
            period=config.period,
            which=0,
            around=make_surroundings(world, None, config),
            kind=0,
        )

        self.radii = self.hall.movers[:, RADIUS].copy()
        self.states = np.zeros((len(self.radii), STATE_NUMBERS))
        self.hit = NO_HIT
        self.intrusions = 0.0
        self._tick = 0
        _begin(self.hall, self.states)

    @property
    def now(self) -> float:
        """Time since the start of the episode [s]."""
        return self._tick * self.hall.period

    def advance(self, pose: Pose, twist: Twist) -> None:
        """Advance by a control period.

        Args:
            pose: Pose of the robot at its end, in the frame of the world.
            twist: Twist of the robot at its end.
        """
        self._tick += 1
        robot = motion_of(pose, twist)
        hit, entered, _ = _advance(self.hall, self.states, self._tick, robot, np.inf)
        self.hit = self.hit or hit
        self.intrusions += entered

    def survey(self, pose: Pose, twist: Twist) -> Point:
        """Return the distance of the nearest mover [m] and the time to collision [s].

        Args:
            pose: Pose of the robot, in the frame of the world.
            twist: Twist of the robot.
        """
        return _survey(self.hall, self.states, motion_of(pose, twist))

    def copy_states(self) -> Floats:
        """Copy what is seen of the movers now, (movers, SEEN_NUMBERS), in the world's frame."""
        return np.column_stack([self.states[:, :CLOCK], self.radii])
