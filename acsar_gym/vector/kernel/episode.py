"""Resets and env steps of many robots."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit, loop, subroutine
from acsar_gym.physics.model import whole_loops
from acsar_gym.physics.randomization import draw_robot
from acsar_gym.tasks.base import point_in_disc, relative_point
from acsar_gym.tasks.episode import goal_at
from acsar_gym.vector.kernel.drive import (
    command_once,
    draw_fault_key,
    drive_robots,
    keep_before_step,
    newest_line,
    restore_silent,
    settle_with_faults,
    store_actions,
)
from acsar_gym.vector.kernel.layout import (
    COMMAND_LOOPS,
    DELAY_LOOPS,
    ERROR,
    FEEDBACK_LOOPS,
    FIRST_RANK,
    GOAL_GIVEN,
    GOAL_X,
    GOAL_Y,
    LAST_LINE,
    LAST_RANK,
    LOOPS,
    ODOM_X,
    ODOM_Y,
    OUTCOME,
    PHYSICS,
    ROBOTS_PER_BLOCK,
    SCAN_AGE,
    SCAN_TICK,
    SILENT,
    STALE,
    START_COS,
    START_SIN,
    START_THETA,
    START_X,
    START_Y,
    STEPS,
    SUCCESS,
    THETA,
    TRUE_DISTANCE,
    TRUE_THETA,
    TURN,
    WISHED_GOAL,
    WISHED_WORLD,
    WISHED_X,
    WISHED_Y,
    WORLD,
    Floats,
    Setup,
    Spawns,
    Tables,
    TaskSetup,
    X,
    Y,
    row,
)
from acsar_gym.vector.kernel.lidars import take_scans
from acsar_gym.vector.pcg import uniform
from acsar_gym.worlds.geometry import Surroundings


@jit
def count_settle_ticks(delay: float, every: float, loops: float) -> float:
    """Number of ticks that a reset waits for two fresh readings, as in `Robot.reset`.

    Args:
        delay: from making a feedback line to its use [firmware loops].
        every: period of feedback lines [firmware loops].
        loops: firmware loops in a tick.
    """
    one: float = np.ceil((np.ceil(every - 1e-9) + delay) / loops)
    two: float = np.ceil((np.ceil(2.0 * every - 1e-9) + delay) / loops)
    return max(one + 1.0, two)


@subroutine
def draw_physics(tables: Tables, i: int, setup: Setup) -> None:
    """Draw robot i's physics for the episode that begins."""
    state, low, high = tables.state, tables.low, tables.high
    samples = np.zeros(len(low))
    for k in range(len(low)):
        if high[k] > low[k]:
            samples[k] = uniform(tables.random, i)
    own, drawn = draw_robot(tables.nominal, low, high, tables.delays, samples, setup.dt)
    for k in range(len(own)):
        state[PHYSICS + k, i] = own[k]
    for k in range(len(tables.drawn)):
        tables.drawn[k, i] = drawn[k]
    late, wire = own.latency_loops, setup.wire_time
    state[COMMAND_LOOPS, i] = late + whole_loops(wire + own.command_delay, setup.dt)
    state[DELAY_LOOPS, i] = late + whole_loops(wire, setup.dt)


@jit
def draw_goal(state: Floats, random: NDArray[np.uint64], i: int, spawns: Spawns) -> None:
    """Set robot i's goal on an open floor: as its reset option says, or drawn in any direction."""
    state[START_COS, i] = 1.0
    if state[WISHED_GOAL, i] > 0.0:
        state[GOAL_X, i], state[GOAL_Y, i] = state[WISHED_X, i], state[WISHED_Y, i]
        return
    distance = spawns.min_distance + (spawns.max_distance - spawns.min_distance) * uniform(
        random, i
    )
    bearing = -math.pi + (math.pi - -math.pi) * uniform(random, i)
    state[GOAL_X, i], state[GOAL_Y, i] = goal_at(distance, bearing)


@jit
def choose_world(state: Floats, i: int, share: float, spawns: Spawns) -> int:
    """Index of robot i's world, as `tasks.spawn.chosen` for a uniform sample `share` of [0, 1)."""
    first, last = int(state[FIRST_RANK, i]), int(state[LAST_RANK, i])
    if state[WISHED_WORLD, i] > 0.0:
        return int(state[WISHED_WORLD, i]) - 1
    if last > first:
        return int(spawns.order[first + min(int(share * (last - first)), last - first - 1)])
    return min(int(share * len(spawns.starts)), len(spawns.starts) - 1)


@jit
def draw_start(state: Floats, random: NDArray[np.uint64], i: int, spawns: Spawns) -> None:
    """Set robot i's world, start and goal, as `tasks.spawn.drawn`."""
    u0, u1, u2 = uniform(random, i), uniform(random, i), uniform(random, i)
    u3, u4, u5 = uniform(random, i), uniform(random, i), uniform(random, i)
    world = choose_world(state, i, u0, spawns)
    start, goal = spawns.starts[world], spawns.goals[world]
    x, y = point_in_disc(start[0], start[1], start[2], u1, u2)
    theta = (2.0 * u3 - 1.0) * math.pi if np.isnan(start[3]) else start[3]
    goal_x, goal_y = point_in_disc(goal[0], goal[1], goal[2], u4, u5)
    cos, sin = math.cos(theta), math.sin(theta)
    state[WORLD, i] = world
    state[START_X, i], state[START_Y, i], state[START_THETA, i] = x, y, theta
    state[START_COS, i], state[START_SIN, i] = cos, sin
    ahead, left = relative_point(x, y, cos, sin, goal_x, goal_y)
    given = state[WISHED_GOAL, i]
    state[GOAL_X, i] = state[WISHED_X, i] if given > 0.0 else ahead
    state[GOAL_Y, i] = state[WISHED_Y, i] if given > 0.0 else left
    state[GOAL_GIVEN, i] = given


@subroutine
def begin_episode(tables: Tables, i: int, setup: Setup, spawns: Spawns) -> None:
    """Begin a new episode of robot i: at rest, with new start, goal and physics."""
    state, random = tables.state, tables.random
    for number in range(COMMAND_LOOPS):
        state[number, i] = 0.0
    tables.counts[:, :, i] = 0.0
    if setup.guarded:
        tables.commands[:, :, i] = 0.0
    if setup.faults.possible:
        draw_fault_key(tables, i, setup)
    if len(spawns.starts) == 0:
        draw_goal(state, random, i, spawns)
    else:
        draw_start(state, random, i, spawns)
    draw_physics(tables, i, setup)
    if setup.faults.possible:
        settle_with_faults(state, i, setup)
        if state[SILENT, i] > 0.0:
            for k in range(tables.ranges.shape[1]):
                tables.ranges[i, k] = tables.observations[i, setup.numbers + k] = 0.0
        return
    settled = count_settle_ticks(state[DELAY_LOOPS, i], state[FEEDBACK_LOOPS, i], setup.loops)
    state[LOOPS, i] = settled * setup.loops
    every = state[FEEDBACK_LOOPS, i]
    state[LAST_LINE, i] = newest_line(state[LOOPS, i], state[DELAY_LOOPS, i], every)


@loop
def reset(
    tables: Tables,
    mask: NDArray[np.bool_],
    first: int,
    last: int,
    setup: Setup,
    spawns: Spawns,
    around: Surroundings,
) -> None:
    """Begin new episodes for the robots of the slice that are in the mask."""
    anew = False
    for i in range(first, last):
        if mask[i]:
            begin_episode(tables, i, setup, spawns)
            anew = True
    if anew and setup.lidar_rate > 0.0:
        take_scans(tables, mask, True, first, last, -1, setup, around)


@loop
def step(tables: Tables, first: int, last: int, setup: Setup, around: Surroundings) -> None:
    """Run physics and driver of the robots over the ticks that `tables.ring` says.

    The step ends with its last tick. `reset` of the robots in `tables.over` comes after this, then
    the task's loops.
    """
    state = tables.state
    for low in range(first, last, ROBOTS_PER_BLOCK):
        high = min(low + ROBOTS_PER_BLOCK, last)
        if tables.ring[2] == 0:
            store_actions(state, tables.actions, low, high)
            if not setup.guarded:
                command_once(state, low, high, setup)
            keep_before_step(tables, low, high, setup)
        drive_robots(tables, low, high, setup, around)
        if tables.ring[3] < setup.ticks:
            continue
        if setup.falls_silent:
            restore_silent(tables, low, high, setup)
        steps = row(state, STEPS, low, high)
        for i in range(high - low):
            steps[i] += 1.0


@loop
def update_info(state: Floats, first: int, last: int, setup: TaskSetup) -> None:
    """Compute the rows of the state that only info uses."""
    xs, ys, thetas = (
        row(state, X, first, last),
        row(state, Y, first, last),
        row(state, THETA, first, last),
    )
    goal_xs, goal_ys = row(state, GOAL_X, first, last), row(state, GOAL_Y, first, last)
    odom_xs, odom_ys = row(state, ODOM_X, first, last), row(state, ODOM_Y, first, last)
    headings, distances = (
        row(state, TRUE_THETA, first, last),
        row(state, TRUE_DISTANCE, first, last),
    )
    errors, outcomes = row(state, ERROR, first, last), row(state, OUTCOME, first, last)
    successes = row(state, SUCCESS, first, last)
    for i in range(last - first):
        x, y, theta = xs[i], ys[i], thetas[i]
        gx, gy, ox, oy = goal_xs[i] - x, goal_ys[i] - y, odom_xs[i] - x, odom_ys[i] - y
        headings[i] = theta - TURN * np.floor(theta / TURN + 0.5)
        distances[i] = math.sqrt(gx * gx + gy * gy)
        errors[i] = math.sqrt(ox * ox + oy * oy)
        successes[i] = 1.0 if outcomes[i] == 1.0 else 0.0
    if setup.lidar_rate > 0.0:
        update_scan_ages(state, first, last, setup)


@subroutine
def update_scan_ages(state: Floats, first: int, last: int, setup: TaskSetup) -> None:
    """Compute the age of every robot's newest scan [s]."""
    for i in range(first, last):
        age = (state[STEPS, i] * setup.ticks - state[SCAN_TICK, i]) * setup.period
        state[SCAN_AGE, i] = age
        state[STALE, i] = 1.0 if age > setup.stale else 0.0
