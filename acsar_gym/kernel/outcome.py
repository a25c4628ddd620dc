"""What is said of each robot after a step: end, reward, observation, rays and info."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from acsar_gym import tasks
from acsar_gym.compiled import jit, loop
from acsar_gym.kernel.layout import (
    AGE,
    ANGULAR,
    CONTACT,
    DISTANCE,
    GOAL_X,
    GOAL_Y,
    KEPT,
    LAST_ANGULAR,
    LAST_LINEAR,
    LINEAR,
    NUMBERS,
    ODOM_THETA,
    ODOM_X,
    ODOM_Y,
    OUTCOME,
    RETURN,
    STEPS,
    THETA,
    TURN,
    Floats,
    Setup,
    X,
    Y,
    row,
)
from acsar_gym.kernel.physics import sincos
from acsar_gym.worlds.geometry import Surroundings, cast

seen_from = jit(tasks.seen_from)
numbers = jit(tasks.point_goal_numbers)
outcome_of = jit(tasks.point_goal_outcome)
reward_of = jit(tasks.point_goal_reward)


@loop
def judge(
    state: Floats, rewards: Floats, ends: NDArray[np.bool_], first: int, last: int, setup: Setup
) -> None:
    """Reward, success, bounds and time limit after an env step; ends is (terminated, truncated)."""
    for i in range(first, last):
        x, y = state[ODOM_X, i], state[ODOM_Y, i]
        dx, dy = state[GOAL_X, i] - x, state[GOAL_Y, i] - y
        before, after = state[DISTANCE, i], math.sqrt(dx * dx + dy * dy)
        start = math.sqrt(x * x + y * y)
        outcome = outcome_of(after, start, setup.tolerance, setup.boundary)
        outcome = 3 if state[CONTACT, i] > 0.0 else outcome
        reward = reward_of(before, after, state[LAST_LINEAR, i], outcome)
        state[DISTANCE, i] = after
        state[OUTCOME, i] = outcome
        state[STEPS, i] += 1.0
        state[RETURN, i] += reward
        rewards[i] = reward
        ends[0, i] = outcome != 0
        ends[1, i] = state[STEPS, i] >= setup.max_steps


@loop
def observe(
    state: Floats, observations: NDArray[np.float32], first: int, last: int, setup: Setup
) -> None:
    """The task's observation of every robot."""
    scales = (setup.max_distance, setup.max_linear, setup.max_angular)
    for i in range(first, last):
        s, c = sincos(state[ODOM_THETA, i])
        distance, ahead, left = seen_from(
            state[ODOM_X, i], state[ODOM_Y, i], c, s, state[GOAL_X, i], state[GOAL_Y, i]
        )
        twist = (state[LINEAR, i], state[ANGULAR, i])
        o0, o1, o2, o3, o4 = numbers(distance, ahead, left, twist, scales)
        observations[i, 0] = o0
        observations[i, 1] = o1
        observations[i, 2] = o2
        observations[i, 3] = o3
        observations[i, 4] = o4
        observations[i, 5] = state[LAST_LINEAR, i]
        observations[i, 6] = state[LAST_ANGULAR, i]


@loop
def look(
    state: Floats, observations: NDArray[np.float32], first: int, last: int, around: Surroundings
) -> None:
    """The ranges of every robot's rays, as shares of the reach, behind its other numbers."""
    if around.directions.shape[0] == 0:
        return
    many = around.circles.shape[0] > 1 or around.segments.shape[0] > 1
    ranges = np.empty(around.directions.shape[0])
    for i in range(first, last):
        s, c = sincos(state[THETA, i])
        cast(state[X, i], state[Y, i], c, s, i if many else 0, around, ranges)
        for k in range(len(ranges)):
            observations[i, NUMBERS + k] = ranges[k] / around.reach


@loop
def report(state: Floats, info: Floats, first: int, last: int) -> None:
    """The info of every robot: one row for each name in INFO."""
    for k in range(KEPT):
        kept, told = row(state, DISTANCE, first, last), row(info, k, first, last)
        if k > 0:
            kept = row(state, AGE if k == KEPT - 1 else ODOM_X + k - 1, first, last)
        for i in range(last - first):
            told[i] = kept[i]
    xs, ys, thetas = (
        row(state, X, first, last),
        row(state, Y, first, last),
        row(state, THETA, first, last),
    )
    goal_xs, goal_ys = row(state, GOAL_X, first, last), row(state, GOAL_Y, first, last)
    odom_xs, odom_ys = row(state, ODOM_X, first, last), row(state, ODOM_Y, first, last)
    contacts, outcomes = row(state, CONTACT, first, last), row(state, OUTCOME, first, last)
    for i in range(last - first):
        x, y, theta = xs[i], ys[i], thetas[i]
        gx, gy, ox, oy = goal_xs[i] - x, goal_ys[i] - y, odom_xs[i] - x, odom_ys[i] - y
        info[KEPT, first + i] = x
        info[KEPT + 1, first + i] = y
        info[KEPT + 2, first + i] = theta - TURN * np.floor(theta / TURN + 0.5)
        info[KEPT + 3, first + i] = math.sqrt(gx * gx + gy * gy)
        info[KEPT + 4, first + i] = contacts[i]
        info[KEPT + 5, first + i] = math.sqrt(ox * ox + oy * oy)
        info[KEPT + 6, first + i] = 1.0 if outcomes[i] == 1.0 else 0.0
