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
from acsar_gym.vector.kernel.crowds import motion_in_world, passers_of
from acsar_gym.vector.kernel.layout import (
    BLOCK_ROBOTS,
    ODOMETRY,
    TRUTH,
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
        if robots.true_contact[i] == 0.0:
            motion = motion_in_world(robots, i)
            is_contact = footprint_collides(
                motion.x,
                motion.y,
                motion.cos,
                motion.sin,
                which=int(robots.world[i]),
                around=around,
                kind=int(robots.kind[i]),
            )
            if is_contact:
                robots.true_contact[i] = 1.0


@jit
def mark_trails(
    robots: Robots, i: int, trails: Floats, robot: int, tick: int, setup: Setup
) -> None:
    """Mark where a robot is in a tick after its reset, by odometry and in truth."""
    now = robots.loops[i] * setup.dt
    x, y = to_world(robots, i, robots.true_x[i], robots.true_y[i])
    true = (x, y, robots.start_theta[i] + robots.theta[i])
    odometry = (robots.odom_x[i], robots.odom_y[i], robots.odom_theta[i])
    if tick == 0:
        begin_trail(trails[ODOMETRY, robot], now, odometry, setup.period)
        begin_trail(trails[TRUTH, robot], now, true, setup.period)

    row = tick % trails.shape[2]
    trails[ODOMETRY, robot, row, 0] = now
    trails[TRUTH, robot, row, 0] = now
    for k in range(3):
        trails[ODOMETRY, robot, row, 1 + k] = odometry[k]
        trails[TRUTH, robot, row, 1 + k] = true[k]


@jit
def traits_of(robots: Robots, i: int) -> LidarTraits:
    """The errors of robot i's LiDAR in this episode."""
    physics = robots.physics
    return LidarTraits(
        scan_rate=physics.scan_rate[i],
        noise=physics.range_noise[i],
        bias=physics.range_bias[i],
        dropouts=physics.range_dropouts[i],
        outliers=physics.range_outliers[i],
        start=robots.scan_start[i],
        phase=robots.scan_phase[i],
        key=robots.scan_key[i],
    )


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
    """Read LiDARs and maps of these blocks' robots, after a reset or a whole step."""
    setup = setups[0]
    trails = scans.trails
    beams = make_beams(tables.ranges.shape[1])
    mapped = np.zeros(len(MAP_NAMES))
    moved = np.zeros(len(MOVER_NAMES))
    first_mover = setup.numbers + len(MAP_NAMES)
    for block in range(first, last):
        robots = tables.blocks[block]
        for i in range(robots_of_block(block, len(tables.begins))):
            robot = block * BLOCK_ROBOTS + i
            begins = tables.begins[robot]
            if not (begins or tables.drives[robot]):
                continue
            world = int(robots.world[i])
            kind = int(robots.kind[i])
            count = int(robots.rays[i])
            now = robots.loops[i] * setup.dt
            tick = 0 if begins else int(robots.steps[i]) * setup.ticks
            newest = tick % trails.shape[2]
            observed = tables.observations[robot]
            passers = see_nobody()
            if crowds is not None:
                passers = passers_of(crowds, robot, world)

            # The LiDAR turns all the time, also before the episode.
            if begins:
                robots.scan_start[i] = now
                robots.scan_phase[i] = uniform(tables.random, robot)
                robots.scan_key[i] = uniform(tables.random, robot)
                mark_trails(robots, i, trails, robot=robot, tick=tick, setup=setup)
                begin_passing(passers, trails[TRUTH, robot])

            # The newest revolution, and what it means for the present pose.
            if len(beams.times) != count:
                beams = make_beams(count)
            stamp = measure_revolution(
                Ring(trails[TRUTH, robot], newest),
                world,
                scans.around,
                rays=scans.rays[kind],
                traits=traits_of(robots, i),
                beams=beams,
                passers=passers,
                kind=kind,
            )
            robots.scan_stamp[i] = stamp
            rays = scans.rays[kind]
            ranges = tables.ranges[robot, :count]
            revolution = Revolution(beams.bearings, beams.distances, beams.times, stamp)
            fill_scan(revolution, Ring(trails[ODOMETRY, robot], newest), rays, ranges=ranges)
            for k in range(count):
                observed[setup.first_ray + k] = ranges[k] / rays.farthest

            # Map and movers.
            if maps is not None:
                record = maps.records[robot]
                pose = (robots.odom_x[i], robots.odom_y[i], robots.odom_theta[i])
                if begins:
                    clear_map(record)
                update_map(
                    record,
                    now,
                    pose,
                    goal=(robots.goal_x[i], robots.goal_y[i]),
                    ranges=ranges,
                    rays=rays,
                    measured=(beams.bearings, beams.times, stamp),
                    scratch=maps.scratch[block],
                    out=mapped,
                )
                for k in range(len(mapped)):
                    observed[setup.numbers + k] = mapped[k]
                if first_mover < setup.first_ray:
                    fill_movers(record, pose, moved)
                    for k in range(len(moved)):
                        observed[first_mover + k] = moved[k]
