"""The movers around many robots, which advance with each tick and are seen by LiDARs."""

from __future__ import annotations

from acsar_gym.jit import jit, subroutine
from acsar_gym.lidar.simulated import Passers
from acsar_gym.trigonometry import sincos
from acsar_gym.vector.kernel.layout import Crowds, Robots, Scans, Setup, to_world
from acsar_gym.worlds.crowd import (
    Hall,
    RobotMotion,
    X,
    Y,
    advance_crowd,
    begin_crowd,
    place_crowd,
    survey_crowd,
)
from acsar_gym.worlds.geometry import outer_radius


@jit
def motion_in_world(robots: Robots, i: int) -> RobotMotion:
    """Where robot i is in the frame of its world, and how it moves."""
    x, y = to_world(robots, i, robots.true_x[i], robots.true_y[i])
    s, c = sincos(robots.theta[i])
    cos = robots.start_cos[i]
    sin = robots.start_sin[i]
    return RobotMotion(
        x=x,
        y=y,
        cos=cos * c - sin * s,
        sin=sin * c + cos * s,
        forward=c * robots.vx[i] + s * robots.vy[i],
        rate=robots.rate[i],
    )


@jit
def hall_of(robots: Robots, i: int, crowds: Crowds, scans: Scans, setup: Setup) -> Hall:
    """What surrounds robot i's movers."""
    world = int(robots.world[i])
    return Hall(
        movers=crowds.motions.movers[world],
        pieces=crowds.motions.pieces[world],
        is_reacting=crowds.motions.reacting[world],
        key=robots.crowd_key[i],
        period=setup.period,
        which=world,
        around=scans.around,
        kind=int(robots.kind[i]),
    )


@subroutine
def begin_movers(
    robots: Robots, i: int, robot: int, crowds: Crowds, scans: Scans, setup: Setup
) -> None:
    """Begin the episode of robot i's movers, to the end of the ticks in which its reset waits."""
    hall = hall_of(robots, i, crowds, scans=scans, setup=setup)
    begin_crowd(hall, crowds.states[robot])
    for tick in range(1, int(robots.loops[i] / setup.loops) + 1):
        advance_movers(robots, i, robot, tick=tick, crowds=crowds, scans=scans, setup=setup)
    survey_movers(robots, i, robot, crowds=crowds, scans=scans, setup=setup)


@jit
def bound_speed(robots: Robots, i: int) -> float:
    """A speed that no wheel of a robot exceeds on the ground until it gets other commands [m/s]."""
    physics = robots.physics
    rules = robots.rules
    smallest = min(rules.left_radius[i], rules.right_radius[i])
    wanted = robots.max_linear[i] + 0.5 * rules.separation[i] * robots.max_angular[i]
    # Motors may already turn faster than the newest command asks for.
    turning = 0.0
    for k in range(4):
        set_point = physics.gain[k, i] * wanted / smallest
        turning = max(turning, abs(robots.wheel_speed[k, i]), set_point)

    turning = min(turning, physics.max_speed[i])
    speed: float = 1.1 * turning * max(physics.left_radius[i], physics.right_radius[i])
    return speed


@subroutine
def advance_movers(
    robots: Robots, i: int, robot: int, tick: int, crowds: Crowds, scans: Scans, setup: Setup
) -> None:
    """Advance robot i's movers to the end of a tick, counted from the reset, and find contacts."""
    hall = hall_of(robots, i, crowds, scans=scans, setup=setup)
    # A corner of the hull moves fastest if the two sides' wheels turn against each other.
    corner = max(outer_radius(hall.around, hall.kind) / robots.physics.half_track[i], 1.0)
    hit, entered, next_look = advance_crowd(
        hall,
        crowds.states[robot],
        tick,
        robot=motion_in_world(robots, i),
        top_speed=corner * bound_speed(robots, i),
    )

    robots.crowd_look[i] = next_look
    robots.intrusions[i] += entered
    if hit > 0.0:
        robots.true_contact[i] = 1.0
        if robots.person_contact[i] == 0.0:
            robots.person_contact[i] = hit


@subroutine
def survey_movers(
    robots: Robots, i: int, robot: int, crowds: Crowds, scans: Scans, setup: Setup
) -> None:
    """Place robot i's movers at the end of a step, and compute what info reports of them."""
    # Movers far away weren't moved in the step, see `advance_crowd`.
    hall = hall_of(robots, i, crowds, scans=scans, setup=setup)
    ticks = robots.loops[i] / setup.loops
    place_crowd(hall, crowds.states[robot], ticks * setup.period)
    closest, soonest = survey_crowd(hall, crowds.states[robot], motion_in_world(robots, i))
    robots.closest_person[i] = closest
    robots.time_to_collision[i] = soonest


@jit
def mark_movers(crowds: Crowds, robot: int, row: int) -> None:
    """Mark where a robot's movers are now, in a row of its trail, for people who react."""
    for m in range(crowds.states.shape[1]):
        crowds.trails[robot, row, m, 0] = crowds.states[robot, m, X]
        crowds.trails[robot, row, m, 1] = crowds.states[robot, m, Y]


@jit
def passers_of(crowds: Crowds, robot: int, world: int) -> Passers:
    """What a robot's LiDAR sees of its movers."""
    motions = crowds.motions
    return Passers(
        motions.movers[world],
        motions.pieces[world],
        crowds.states[robot],
        places=crowds.trails[robot],
    )
