"""Resets of many robots, and what only info uses."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit, loop
from acsar_gym.links.faults import WHOLE_EPISODE, line_hash
from acsar_gym.physics.model import whole_loops
from acsar_gym.physics.randomization import draw_robot
from acsar_gym.safety.rules import SafetyRules
from acsar_gym.tasks.base import point_in_disc, relative_point
from acsar_gym.tasks.episode import goal_at
from acsar_gym.vector.kernel import layout as rows
from acsar_gym.vector.kernel.drive import newest_line, settle_with_faults
from acsar_gym.vector.kernel.layout import Floats, Records, Spawns, Tables, row
from acsar_gym.vector.kernel.lidars import mark_trails, read_scans
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


@jit
def draw_goal(state: Floats, random: NDArray[np.uint64], i: int, spawns: Spawns) -> None:
    """Set robot i's goal on an open floor: as its reset option says, or drawn in any direction."""
    state[rows.START_COS, i] = 1.0
    if state[rows.WISHED_GOAL, i] > 0.0:
        state[rows.GOAL_X, i], state[rows.GOAL_Y, i] = (
            state[rows.WISHED_X, i],
            state[rows.WISHED_Y, i],
        )
        return
    distance = spawns.min_distance + (spawns.max_distance - spawns.min_distance) * uniform(
        random, i
    )
    bearing = -math.pi + (math.pi - -math.pi) * uniform(random, i)
    state[rows.GOAL_X, i], state[rows.GOAL_Y, i] = goal_at(distance, bearing)


@jit
def draw_start(state: Floats, random: NDArray[np.uint64], i: int, spawns: Spawns) -> None:
    """Set robot i's world, start and goal, as `tasks.episode.draw_in_world`."""
    u0, u1, u2 = uniform(random, i), uniform(random, i), uniform(random, i)
    u3, u4, u5 = uniform(random, i), uniform(random, i), uniform(random, i)
    low, high = int(state[rows.FIRST_RANK, i]), int(state[rows.LAST_RANK, i])
    world = min(int(u0 * len(spawns.starts)), len(spawns.starts) - 1)
    if state[rows.WISHED_WORLD, i] > 0.0:
        world = int(state[rows.WISHED_WORLD, i]) - 1
    elif high > low:
        world = spawns.order[low + min(int(u0 * (high - low)), high - low - 1)]
    start, goal = spawns.starts[world], spawns.goals[world]
    x, y = point_in_disc(start[0], start[1], start[2], u1, u2)
    theta = (2.0 * u3 - 1.0) * math.pi if np.isnan(start[3]) else start[3]
    goal_x, goal_y = point_in_disc(goal[0], goal[1], goal[2], u4, u5)
    cos, sin = math.cos(theta), math.sin(theta)
    state[rows.WORLD, i] = world
    state[rows.START_X, i], state[rows.START_Y, i], state[rows.START_THETA, i] = x, y, theta
    state[rows.START_COS, i], state[rows.START_SIN, i] = cos, sin
    ahead, left = relative_point(x, y, cos, sin, goal_x, goal_y)
    given = state[rows.WISHED_GOAL, i]
    state[rows.GOAL_X, i] = state[rows.WISHED_X, i] if given > 0.0 else ahead
    state[rows.GOAL_Y, i] = state[rows.WISHED_Y, i] if given > 0.0 else left
    state[rows.GOAL_GIVEN, i] = given


@loop
def reset(  # noqa: C901, PLR0912 - as `drive.step`
    tables: Tables,
    first: int,
    last: int,
    setups: Records,
    rules: SafetyRules,
    spawns: Spawns,
    around: Surroundings,
) -> None:
    """Begin new episodes for the robots of the slice that are in `tables.over`.

    They are at rest, with new start, goal and physics. Where a single env's reset would fail
    because the board is silent, SILENT is set.
    """
    setup, state, random = setups[0], tables.state, tables.random
    faulty = setup.faults.possible
    samples, anew = np.zeros(len(tables.low)), False
    for i in range(first, last):
        if not tables.over[i]:
            continue
        anew = True
        for number in range(rows.COMMAND_LOOPS):
            state[number, i] = 0.0
        tables.counts[:, :, i] = 0.0
        if setup.guarded:
            tables.commands[:, :, i] = 0.0
        if faulty:
            key = uniform(random, i)
            ill = line_hash(key, WHOLE_EPISODE, 0.0, 0) < setup.faults.episodes
            state[rows.KEY, i] = key if ill else -1.0
        if len(spawns.starts) == 0:
            draw_goal(state, random, i, spawns)
        else:
            draw_start(state, random, i, spawns)
        for k in range(len(samples)):
            if tables.high[k] > tables.low[k]:
                samples[k] = uniform(random, i)
        own, drawn = draw_robot(
            tables.nominal, tables.low, tables.high, tables.delays, samples, setup.dt
        )
        for k in range(len(own)):
            state[rows.PHYSICS + k, i] = own[k]
        for k in range(len(tables.drawn)):
            tables.drawn[k, i] = drawn[k]
        wire, late = setup.wire_time, own.latency_loops
        state[rows.COMMAND_LOOPS, i] = late + whole_loops(wire + own.command_delay, setup.dt)
        state[rows.DELAY_LOOPS, i] = late + whole_loops(wire, setup.dt)
        if faulty:
            settle_with_faults(state, i, setup, rules)
        else:
            delay, every = state[rows.DELAY_LOOPS, i], state[rows.FEEDBACK_LOOPS, i]
            loops = count_settle_ticks(delay, every, setup.loops) * setup.loops
            state[rows.LOOPS, i] = loops
            state[rows.LAST_LINE, i] = newest_line(loops, delay, every)
        if state[rows.SILENT, i] > 0.0:
            for k in range(tables.ranges.shape[1]):
                tables.ranges[i, k] = tables.observations[i, setup.numbers + k] = 0.0
        elif setup.sees:
            state[rows.SCAN_START, i] = state[rows.LOOPS, i] * setup.dt
            state[rows.SCAN_PHASE, i] = uniform(random, i)
            state[rows.SCAN_KEY, i] = uniform(random, i)
            mark_trails(tables, i, setup, 0.0)
    if anew and setup.sees:
        read_scans(tables, first, last, setup, around, True)


@loop
def update_info(state: Floats, first: int, last: int, setups: Records) -> None:
    """Compute the rows of the state that only info uses."""
    setup = setups[0]
    xs = row(state, rows.X, first, last)
    ys = row(state, rows.Y, first, last)
    thetas = row(state, rows.THETA, first, last)
    goal_xs, goal_ys = row(state, rows.GOAL_X, first, last), row(state, rows.GOAL_Y, first, last)
    odom_xs, odom_ys = row(state, rows.ODOM_X, first, last), row(state, rows.ODOM_Y, first, last)
    headings = row(state, rows.TRUE_THETA, first, last)
    distances = row(state, rows.TRUE_DISTANCE, first, last)
    errors, outcomes = row(state, rows.ERROR, first, last), row(state, rows.OUTCOME, first, last)
    successes = row(state, rows.SUCCESS, first, last)
    for i in range(last - first):
        x, y, theta = xs[i], ys[i], thetas[i]
        gx, gy, ox, oy = goal_xs[i] - x, goal_ys[i] - y, odom_xs[i] - x, odom_ys[i] - y
        headings[i] = theta - rows.TURN * np.floor(theta / rows.TURN + 0.5)
        distances[i] = math.sqrt(gx * gx + gy * gy)
        errors[i] = math.sqrt(ox * ox + oy * oy)
        successes[i] = 1.0 if outcomes[i] == 1.0 else 0.0
    if setup.sees:
        for i in range(first, last):
            age = state[rows.LOOPS, i] * setup.dt - state[rows.SCAN_STAMP, i]
            state[rows.SCAN_AGE, i] = age
            state[rows.STALE, i] = 1.0 if age > setup.stale else 0.0
