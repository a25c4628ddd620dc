"""Collisions of exact footprints and LiDAR scans of many robots in their worlds."""

from __future__ import annotations

import numpy as np

from acsar_gym.jit import jit, loop, subroutine
from acsar_gym.lidar.scan import Revolution, Ring, begin_trail, fill_scan
from acsar_gym.lidar.simulated import (
    LidarTraits,
    begin_passing,
    make_beams,
    measure_revolution,
    see_nobody,
)
from acsar_gym.sensors.map.movers import MOVER_NAMES, fill_movers
from acsar_gym.sensors.map.sensor import MAP_NAMES, clear_map, update_map
from acsar_gym.trigonometry import sincos
from acsar_gym.vector.kernel.crowds import passers_of
from acsar_gym.vector.kernel.layout import (
    BLOCK_ROBOTS,
    Crowds,
    Floats,
    Maps,
    Records,
    Robots,
    Scans,
    Setup,
    Tables,
    robots_of_block,
    to_world,
)
from acsar_gym.vector.pcg import uniform
from acsar_gym.worlds.geometry import Surroundings, footprint_collides


@subroutine
def check_contacts(robots: Robots, count: int, around: Surroundings) -> None:
    """Set `contact` of robots that touch an obstacle now."""
    for i in range(count):
        if robots.contact[i] == 0.0:
            x, y = to_world(robots, i, robots.x[i], robots.y[i])
            s, c = sincos(robots.theta[i])
            cos, sin = robots.start_cos[i], robots.start_sin[i]
            cos, sin = cos * c - sin * s, sin * c + cos * s
            kind = int(robots.kind[i])
            if footprint_collides(x, y, cos, sin, int(robots.world[i]), around, kind):
                robots.contact[i] = 1.0


@jit
def mark_trails(
    robots: Robots, i: int, trails: Floats, robot: int, tick: float, setup: Setup
) -> None:
    """Mark where a robot is, so many ticks after its reset, by odometry and in truth."""
    x, y = to_world(robots, i, robots.x[i], robots.y[i])
    true = x, y, robots.start_theta[i] + robots.theta[i]
    odometry = robots.odom_x[i], robots.odom_y[i], robots.odom_theta[i]
    now = robots.loops[i] * setup.dt
    if tick == 0.0:
        begin_trail(trails[0, robot], now, odometry, setup.period)
        begin_trail(trails[1, robot], now, true, setup.period)
    row = int(tick) % trails.shape[2]
    for k in range(3):
        trails[0, robot, row, 1 + k], trails[1, robot, row, 1 + k] = odometry[k], true[k]
    trails[0, robot, row, 0] = trails[1, robot, row, 0] = now


@loop
def read_scans(  # noqa: C901 - as `drive.step`
    tables: Tables,
    scans: Scans,
    crowds: Crowds | None,
    maps: Maps | None,
    first: int,
    last: int,
    setups: Records,
) -> None:
    """Read LiDARs and maps of these blocks' robots, after a reset or a whole step.

    Robots in `over` begin an episode. Those whose board is silent have no scan, as in the single
    env, whose reset fails.
    """
    setup, trails = setups[0], scans.trails
    nobody = see_nobody()
    beams, mapped = make_beams(tables.ranges.shape[1]), np.zeros(len(MAP_NAMES))
    first_mover, moved = setup.numbers + len(MAP_NAMES), np.zeros(len(MOVER_NAMES))
    for block in range(first, last):
        robots = tables.blocks[block]
        for i in range(robots_of_block(block, len(tables.over))):
            robot = block * BLOCK_ROBOTS + i
            begins = tables.over[robot]
            if robots.silent[i] > 0.0 if begins else tables.idle[robot]:
                continue
            tick = 0.0 if begins else robots.steps[i] * setup.ticks
            passers = nobody
            if crowds is not None:
                passers = passers_of(crowds, robot, int(robots.world[i]))
            if begins:
                robots.scan_start[i] = robots.loops[i] * setup.dt
                robots.scan_phase[i] = uniform(tables.random, robot)
                robots.scan_key[i] = uniform(tables.random, robot)
                mark_trails(robots, i, trails, robot, tick, setup)
                begin_passing(passers, trails[1, robot])
            newest = int(tick) % trails.shape[2]
            physics = robots.physics
            kind, count = int(robots.kind[i]), int(robots.rays[i])
            rays = scans.rays[kind]
            if len(beams.times) != count:
                beams = make_beams(count)
            traits = LidarTraits(
                physics.scan_rate[i],
                physics.range_noise[i],
                physics.range_bias[i],
                physics.range_dropouts[i],
                physics.range_outliers[i],
                robots.scan_start[i],
                robots.scan_phase[i],
                robots.scan_key[i],
            )
            stamp = measure_revolution(
                Ring(trails[1, robot], newest),
                int(robots.world[i]),
                scans.around,
                rays=rays,
                traits=traits,
                beams=beams,
                passers=passers,
                kind=kind,
            )
            robots.scan_stamp[i] = stamp
            ranges = tables.ranges[robot, :count]
            revolution = Revolution(beams.bearings, beams.distances, beams.times, stamp)
            fill_scan(revolution, Ring(trails[0, robot], newest), rays, ranges=ranges)
            for k in range(count):
                tables.observations[robot, setup.first_ray + k] = ranges[k] / rays.farthest
            if maps is not None:
                if begins:
                    clear_map(maps.records[robot])
                pose = robots.odom_x[i], robots.odom_y[i], robots.odom_theta[i]
                update_map(
                    maps.records[robot],
                    robots.loops[i] * setup.dt,
                    pose,
                    (robots.goal_x[i], robots.goal_y[i]),
                    ranges,
                    rays,
                    (beams.bearings, beams.times, robots.scan_stamp[i]),
                    maps.scratch[block],
                    mapped,
                )
                for k in range(len(mapped)):
                    tables.observations[robot, setup.numbers + k] = mapped[k]
                if first_mover < setup.first_ray:
                    fill_movers(maps.records[robot], pose, moved)
                    for k in range(len(moved)):
                        tables.observations[robot, first_mover + k] = moved[k]
