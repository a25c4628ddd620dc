"""The movers around many robots: advanced with each tick, and seen by LiDARs."""

from __future__ import annotations

import numpy as np

from acsar_gym.jit import jit, subroutine
from acsar_gym.lidar.simulated import Passers, begin_passing
from acsar_gym.trigonometry import sincos
from acsar_gym.vector.kernel.layout import Crowds, Floats, Robots, Scans, Setup, to_world
from acsar_gym.worlds.crowd import (
    X,
    Y,
    RobotMotion,
    advance_crowd,
    begin_crowd,
    place_crowd,
    survey_crowd,
)


@jit
def motion_in_world(robots: Robots, i: int) -> RobotMotion:
    """Where robot i is in the frame of its world, and how it moves."""
    x, y = to_world(robots, i, robots.x[i], robots.y[i])
    s, c = sincos(robots.theta[i])
    cos, sin = robots.start_cos[i], robots.start_sin[i]
    forward = c * robots.vx[i] + s * robots.vy[i]
    return RobotMotion(x, y, cos * c - sin * s, sin * c + cos * s, forward, robots.rate[i])


@subroutine
def begin_movers(
    robots: Robots, i: int, robot: int, crowds: Crowds, scans: Scans, setup: Setup
) -> None:
    """Begin the episode of robot i's movers, up to the end of the ticks in which its reset waits."""
    world = int(robots.world[i])
    movers, pieces = crowds.motions.movers[world], crowds.motions.pieces[world]
    begin_crowd(movers, pieces, crowds.states[robot], robots.crowd_key[i])
    for tick in range(1, int(robots.loops[i] / setup.loops) + 1):
        advance_movers(robots, i, robot, tick, crowds, scans, setup)
    survey_movers(robots, i, robot, crowds, scans, setup)


@subroutine
def advance_movers(
    robots: Robots, i: int, robot: int, tick: int, crowds: Crowds, scans: Scans, setup: Setup
) -> None:
    """Advance robot i's movers to the end of a tick, its number since the reset; look for contacts."""
    world, physics = int(robots.world[i]), robots.physics
    radius = max(physics.left_radius[i], physics.right_radius[i])
    hit, entered, look = advance_crowd(
        crowds.motions.movers[world],
        crowds.motions.pieces[world],
        crowds.states[robot],
        tick,
        setup.period,
        robots.crowd_key[i],
        motion_in_world(robots, i),
        np.inf if crowds.motions.reacting[world] else physics.max_speed[i] * radius,
        world,
        scans.around,
        int(robots.kind[i]),
    )
    robots.crowd_look[i] = look
    robots.intrusions[i] += entered
    if robots.person_contact[i] == 0.0:
        robots.person_contact[i] = hit
    if hit > 0.0:
        robots.contact[i] = 1.0


@subroutine
def survey_movers(
    robots: Robots, i: int, robot: int, crowds: Crowds, scans: Scans, setup: Setup
) -> None:
    """Place robot i's movers at the end of a step, and compute what info says of them."""
    world, now = int(robots.world[i]), robots.loops[i] / setup.loops * setup.period
    movers, states = crowds.motions.movers[world], crowds.states[robot]
    place_crowd(movers, crowds.motions.pieces[world], states, now)
    near = survey_crowd(
        movers, states, motion_in_world(robots, i), scans.around, int(robots.kind[i])
    )
    robots.closest_person[i], robots.time_to_collision[i] = near


@jit
def mark_movers(crowds: Crowds, robot: int, row: int) -> None:
    """Mark where a robot's movers are now, in a row of its trail; needed for people who react."""
    for m in range(crowds.states.shape[1]):
        crowds.trails[robot, row, m, 0] = crowds.states[robot, m, X]
        crowds.trails[robot, row, m, 1] = crowds.states[robot, m, Y]


@jit
def passers_of(crowds: Crowds, robot: int, world: int) -> Passers:
    """What a robot's LiDAR sees of its movers."""
    motions = crowds.motions
    return Passers(
        motions.movers[world], motions.pieces[world], crowds.states[robot], crowds.trails[robot]
    )


@subroutine
def begin_trails(crowds: Crowds, robot: int, world: int, trail: Floats) -> None:
    """Begin the trails of a robot's movers where its own has begun."""
    begin_passing(passers_of(crowds, robot, world), trail)
    mark_movers(crowds, robot, 0)
