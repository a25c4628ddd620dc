"""Resets of many robots, and what only info uses."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit, loop
from acsar_gym.physics.model import whole_loops
from acsar_gym.physics.randomization import draw_robot
from acsar_gym.tasks.episode import goal_at
from acsar_gym.tasks.task import point_in_disc, relative_point
from acsar_gym.vector.kernel.crowds import begin_movers
from acsar_gym.vector.kernel.drive import newest_line
from acsar_gym.vector.kernel.layout import (
    BLOCK_ROBOTS,
    EPISODE_ROWS,
    PHYSICS_ROW,
    TURN,
    Crowds,
    Draws,
    Floats,
    Records,
    Robots,
    Scans,
    Setup,
    Spawns,
    Tables,
    robots_of_block,
)
from acsar_gym.vector.pcg import uniform
from acsar_gym.worlds.movers import RADIUS

Generators = NDArray[np.uint64]


@jit
def count_settle_ticks(delay: float, every: float, loops: float) -> float:
    """Number of ticks that a reset waits for two fresh readings, as in `Robot.reset`."""
    first: float = np.ceil((np.ceil(every - 1e-9) + delay) / loops)
    second: float = np.ceil((np.ceil(2.0 * every - 1e-9) + delay) / loops)
    return max(first + 1.0, second)


@jit
def clear_robot(numbers: Floats, counts: Floats, commands: Floats, i: int) -> None:
    """Set to zero what robot i of a block remembers of its last episode."""
    for row in range(EPISODE_ROWS):
        numbers[row, i] = 0.0
    for slot in range(counts.shape[0]):
        for k in range(4):
            counts[slot, k, i] = 0.0
    for slot in range(commands.shape[0]):
        for side in range(2):
            commands[slot, side, i] = 0.0


@jit
def draw_goal(robots: Robots, i: int, random: Generators, robot: int, spawns: Spawns) -> None:
    """Set robot i's goal on an open floor: as its reset option says, or drawn in any direction."""
    robots.start_cos[i] = 1.0
    if robots.wished_goal[i] > 0.0:
        robots.goal_x[i] = robots.wished_x[i]
        robots.goal_y[i] = robots.wished_y[i]
        return

    span = spawns.max_distance - spawns.min_distance
    distance = spawns.min_distance + span * uniform(random, robot)
    bearing = -math.pi + (math.pi - -math.pi) * uniform(random, robot)
    x, y = goal_at(distance, bearing)
    robots.goal_x[i] = x
    robots.goal_y[i] = y


@jit
def draw_start(robots: Robots, i: int, random: Generators, robot: int, spawns: Spawns) -> None:
    """Set robot i's world, start and goal, as `tasks.episode.draw_in_world`."""
    of_world = uniform(random, robot)
    of_start = (uniform(random, robot), uniform(random, robot))
    of_heading = uniform(random, robot)
    of_goal = (uniform(random, robot), uniform(random, robot))

    # The world: by its number, among those of a difficulty, or among all.
    low = int(robots.first_rank[i])
    high = int(robots.last_rank[i])
    first = int(robots.first_world[i])
    worlds = int(robots.worlds[i])
    world = first + min(int(of_world * worlds), worlds - 1)
    if robots.wished_world[i] > 0.0:
        world = first + int(robots.wished_world[i]) - 1
    elif high > low:
        rank = low + min(int(of_world * (high - low)), high - low - 1)
        world = spawns.order[first + rank]
    robots.world[i] = world

    # The start, in the frame of the world.
    start = spawns.starts[world]
    x, y = point_in_disc(start.x, start.y, start.radius, of_start[0], of_start[1])
    theta = (2.0 * of_heading - 1.0) * math.pi if np.isnan(start.theta) else start.theta
    cos = math.cos(theta)
    sin = math.sin(theta)
    robots.start_x[i] = x
    robots.start_y[i] = y
    robots.start_theta[i] = theta
    robots.start_cos[i] = cos
    robots.start_sin[i] = sin

    # The goal, in the odometry frame.
    goal = spawns.goals[world]
    goal_x, goal_y = point_in_disc(goal.x, goal.y, goal.radius, of_goal[0], of_goal[1])
    ahead, aside = relative_point(x, y, cos, sin=sin, other_x=goal_x, other_y=goal_y)
    is_wished = robots.wished_goal[i]
    robots.goal_x[i] = robots.wished_x[i] if is_wished > 0.0 else ahead
    robots.goal_y[i] = robots.wished_y[i] if is_wished > 0.0 else aside
    robots.goal_given[i] = is_wished


@jit
def time_lines(robots: Robots, i: int, setup: Setup) -> None:
    """Compute how long lines of robot i's episode take, and how long its reset waits for them."""
    physics = robots.physics
    late = physics.latency_loops[i]
    every = physics.feedback_loops[i]
    reaction = setup.wire_time + physics.command_delay[i]
    delay = late + whole_loops(setup.wire_time, setup.dt)
    loops = count_settle_ticks(delay, every, setup.loops) * setup.loops

    robots.command_loops[i] = late + whole_loops(reaction, setup.dt)
    robots.feedback_delay[i] = delay
    robots.loops[i] = loops
    robots.last_line[i] = newest_line(loops, delay, every)


@loop
def reset(  # noqa: C901, PLR0913, PLR0917 - as `drive.step`
    tables: Tables,
    matrices: Floats,
    scans: Scans | None,
    crowds: Crowds | None,
    draws: Draws,
    first: int,
    last: int,
    setups: Records,
    spawns: Spawns,
) -> None:
    """Begin new episodes for the robots of these blocks that are in `tables.begins`.

    They are at rest, with new start, goal and physics. `matrices` are the same memory as the
    blocks, see `layout.view_numbers`.
    """
    setup = setups[0]
    random = tables.random
    samples = np.zeros(draws.low.shape[1])
    for block in range(first, last):
        robots = tables.blocks[block]
        numbers = matrices[block]
        for i in range(robots_of_block(block, len(tables.begins))):
            robot = block * BLOCK_ROBOTS + i
            if not tables.begins[robot]:
                continue
            clear_robot(numbers, tables.counts[block], tables.commands[block], i)

            # World, start and goal.
            if len(spawns.starts) == 0:
                draw_goal(robots, i, random, robot=robot, spawns=spawns)
            else:
                draw_start(robots, i, random, robot=robot, spawns=spawns)
                if crowds is not None:
                    world = int(robots.world[i])
                    if crowds.motions.movers[world, 0, RADIUS] > 0.0:
                        robots.crowd_key[i] = uniform(random, robot)

            # The episode's physics.
            kind = int(robots.kind[i])
            low = draws.low[kind]
            high = draws.high[kind]
            for k in range(len(samples)):
                if high[k] > low[k]:
                    samples[k] = uniform(random, robot)
            physics, drawn = draw_robot(
                draws.nominal[kind],
                low,
                high,
                delays=draws.delays[kind, : draws.delay_counts[kind]],
                samples=samples,
                dt=setup.dt,
            )
            for k in range(len(physics)):
                numbers[PHYSICS_ROW + k, i] = physics[k]
            for k in range(draws.drawn.shape[1]):
                draws.drawn[robot, k] = drawn[k]

            # The ticks in which the reset waits. People walk in them.
            time_lines(robots, i, setup)
            if crowds is not None and scans is not None:
                begin_movers(robots, i, robot, crowds=crowds, scans=scans, setup=setup)


@loop
def update_info(blocks: Any, first: int, last: int, setups: Records) -> None:
    """Compute the numbers of these blocks' robots that only info uses."""
    setup = setups[0]
    for block in range(first, last):
        robots = blocks[block]
        for i in range(BLOCK_ROBOTS):
            theta = robots.theta[i]
            robots.true_theta[i] = theta - TURN * np.floor(theta / TURN + 0.5)

            goal_dx = robots.goal_x[i] - robots.true_x[i]
            goal_dy = robots.goal_y[i] - robots.true_y[i]
            robots.true_goal_distance[i] = math.sqrt(goal_dx * goal_dx + goal_dy * goal_dy)

            odom_dx = robots.odom_x[i] - robots.true_x[i]
            odom_dy = robots.odom_y[i] - robots.true_y[i]
            robots.odometry_error[i] = math.sqrt(odom_dx * odom_dx + odom_dy * odom_dy)

            robots.is_success[i] = 1.0 if robots.outcome[i] == 1.0 else 0.0
            if setup.sees:
                age = robots.loops[i] * setup.dt - robots.scan_stamp[i]
                robots.scan_age[i] = age
                robots.scan_stale[i] = 1.0 if age > robots.stale[i] else 0.0
