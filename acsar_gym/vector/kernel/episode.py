"""Resets of many robots, and what only info uses."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit, loop
from acsar_gym.links.faults import WHOLE_EPISODE, line_hash
from acsar_gym.physics.model import whole_loops
from acsar_gym.physics.randomization import draw_robot
from acsar_gym.tasks.episode import goal_at
from acsar_gym.tasks.task import point_in_disc, relative_point
from acsar_gym.vector.kernel.crowds import begin_movers
from acsar_gym.vector.kernel.drive import newest_line, settle_with_faults
from acsar_gym.vector.kernel.layout import (
    BLOCK_ROBOTS,
    EPISODE_ROWS,
    PHYSICS_ROW,
    TURN,
    Commands,
    Crowds,
    Draws,
    Lines,
    Records,
    Robots,
    Scans,
    Spawns,
    Tables,
    robots_of_block,
)
from acsar_gym.vector.pcg import uniform
from acsar_gym.worlds.movers import RADIUS


@jit
def count_settle_ticks(delay: float, every: float, loops: float) -> float:
    """Number of ticks that a reset waits for two fresh readings, as in `Robot.reset`."""
    one: float = np.ceil((np.ceil(every - 1e-9) + delay) / loops)
    two: float = np.ceil((np.ceil(2.0 * every - 1e-9) + delay) / loops)
    return max(one + 1.0, two)


@jit
def draw_goal(
    robots: Robots, i: int, random: NDArray[np.uint64], robot: int, spawns: Spawns
) -> None:
    """Set robot i's goal on an open floor: as its reset option says, or drawn in any direction."""
    robots.start_cos[i] = 1.0
    if robots.wished_goal[i] > 0.0:
        robots.goal_x[i], robots.goal_y[i] = robots.wished_x[i], robots.wished_y[i]
        return
    distance = spawns.min_distance + (spawns.max_distance - spawns.min_distance) * uniform(
        random, robot
    )
    bearing = -math.pi + (math.pi - -math.pi) * uniform(random, robot)
    robots.goal_x[i], robots.goal_y[i] = goal_at(distance, bearing)


@jit
def draw_start(
    robots: Robots, i: int, random: NDArray[np.uint64], robot: int, spawns: Spawns
) -> None:
    """Set robot i's world, start and goal, as `tasks.episode.draw_in_world`."""
    u0, u1, u2 = uniform(random, robot), uniform(random, robot), uniform(random, robot)
    u3, u4, u5 = uniform(random, robot), uniform(random, robot), uniform(random, robot)
    low, high = int(robots.first_rank[i]), int(robots.last_rank[i])
    first, worlds = int(robots.first_world[i]), int(robots.worlds[i])
    world = first + min(int(u0 * worlds), worlds - 1)
    if robots.wished_world[i] > 0.0:
        world = first + int(robots.wished_world[i]) - 1
    elif high > low:
        world = spawns.order[first + low + min(int(u0 * (high - low)), high - low - 1)]
    start, goal = spawns.starts[world], spawns.goals[world]
    x, y = point_in_disc(start[0], start[1], start[2], u1, u2)
    theta = (2.0 * u3 - 1.0) * math.pi if np.isnan(start[3]) else start[3]
    goal_x, goal_y = point_in_disc(goal[0], goal[1], goal[2], u4, u5)
    cos, sin = math.cos(theta), math.sin(theta)
    robots.world[i] = world
    robots.start_x[i], robots.start_y[i], robots.start_theta[i] = x, y, theta
    robots.start_cos[i], robots.start_sin[i] = cos, sin
    ahead, left = relative_point(x, y, cos, sin, goal_x, goal_y)
    given = robots.wished_goal[i]
    robots.goal_x[i] = robots.wished_x[i] if given > 0.0 else ahead
    robots.goal_y[i] = robots.wished_y[i] if given > 0.0 else left
    robots.goal_given[i] = given


@loop
def reset(  # noqa: C901, PLR0912, PLR0913, PLR0917 - as `drive.step`
    tables: Tables,
    commands: Commands | None,
    lines: Lines | None,
    scans: Scans | None,
    crowds: Crowds | None,
    draws: Draws,
    first: int,
    last: int,
    setups: Records,
    spawns: Spawns,
) -> None:
    """Begin new episodes for the robots of these blocks that are in `tables.over`.

    They are at rest, with new start, goal and physics. Where a single env's reset would fail
    because the board is silent, `silent` is set.
    """
    setup, random = setups[0], tables.random
    samples = np.zeros(draws.low.shape[1])
    for block in range(first, last):
        robots = tables.blocks[block]
        for i in range(robots_of_block(block, len(tables.over))):
            robot = block * BLOCK_ROBOTS + i
            if not tables.over[robot]:
                continue
            for row in range(EPISODE_ROWS):
                tables.numbers[block, row, i] = 0.0
            for slot in range(tables.counts.shape[1]):
                for k in range(4):
                    tables.counts[block, slot, k, i] = 0.0
            if commands is not None:
                for slot in range(commands.shape[1]):
                    commands[block, slot, 0, i] = commands[block, slot, 1, i] = 0.0
            if lines is not None:
                key = uniform(random, robot)
                ill = line_hash(key, WHOLE_EPISODE, 0.0, 0) < setup.faults.episodes
                robots.key[i] = key if ill else -1.0
            if len(spawns.starts) == 0:
                draw_goal(robots, i, random, robot, spawns)
            else:
                draw_start(robots, i, random, robot, spawns)
                if (
                    crowds is not None
                    and crowds.motions.movers[int(robots.world[i]), 0, RADIUS] > 0.0
                ):
                    robots.crowd_key[i] = uniform(random, robot)
            kind = int(robots.kind[i])
            low, high = draws.low[kind], draws.high[kind]
            for k in range(len(samples)):
                if high[k] > low[k]:
                    samples[k] = uniform(random, robot)
            delays = draws.delays[kind, : draws.delay_counts[kind]]
            physics, drawn = draw_robot(
                draws.nominal[kind], low, high, delays=delays, samples=samples, dt=setup.dt
            )
            for k in range(len(physics)):
                tables.numbers[block, PHYSICS_ROW + k, i] = physics[k]
            for k in range(draws.drawn.shape[1]):
                draws.drawn[robot, k] = drawn[k]
            late = physics.latency_loops
            delay, every = late + whole_loops(setup.wire_time, setup.dt), physics.feedback_loops
            reaction = setup.wire_time + physics.command_delay
            robots.command_loops[i] = late + whole_loops(reaction, setup.dt)
            robots.feedback_delay[i] = delay
            loops = count_settle_ticks(delay, every, setup.loops) * setup.loops
            robots.loops[i], robots.last_line[i] = loops, newest_line(loops, delay, every)
            if lines is not None:
                settle_with_faults(robots, i, setup)
                if robots.silent[i] > 0.0:
                    for k in range(tables.ranges.shape[1]):
                        tables.ranges[robot, k] = 0.0
                    for k in range(setup.numbers, setup.first_ray + tables.ranges.shape[1]):
                        tables.observations[robot, k] = 0.0
            if crowds is not None and scans is not None:
                begin_movers(robots, i, robot, crowds, scans, setup)


@loop
def update_info(blocks: Any, first: int, last: int, setups: Records) -> None:
    """Compute the numbers of these blocks' robots that only info uses."""
    setup = setups[0]
    for block in range(first, last):
        robots = blocks[block]
        for i in range(BLOCK_ROBOTS):
            x, y, theta = robots.x[i], robots.y[i], robots.theta[i]
            to_x, to_y = robots.goal_x[i] - x, robots.goal_y[i] - y
            off_x, off_y = robots.odom_x[i] - x, robots.odom_y[i] - y
            robots.true_theta[i] = theta - TURN * np.floor(theta / TURN + 0.5)
            robots.goal_distance[i] = math.sqrt(to_x * to_x + to_y * to_y)
            robots.odom_error[i] = math.sqrt(off_x * off_x + off_y * off_y)
            robots.success[i] = 1.0 if robots.outcome[i] == 1.0 else 0.0
            if setup.sees:
                age = robots.loops[i] * setup.dt - robots.scan_stamp[i]
                robots.scan_age[i] = age
                robots.scan_stale[i] = 1.0 if age > robots.stale[i] else 0.0
