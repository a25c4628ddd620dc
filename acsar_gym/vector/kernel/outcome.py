"""What is said of each robot after a step: end, reward, observation and info."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit, loop
from acsar_gym.tasks.barn import scores
from acsar_gym.tasks.goal import goal_numbers, goal_outcome, goal_reward, seen_from
from acsar_gym.vector.kernel.dynamics import sincos
from acsar_gym.vector.kernel.layout import (
    ANGULAR,
    CONTACT,
    DISTANCE,
    ERROR,
    GOAL_GIVEN,
    GOAL_X,
    GOAL_Y,
    LAST_ANGULAR,
    LAST_LINEAR,
    LINEAR,
    ODOM_THETA,
    ODOM_X,
    ODOM_Y,
    OUTCOME,
    RETURN,
    SCAN_AGE,
    SCAN_TICK,
    SCORE,
    STALE,
    STEPS,
    SUCCESS,
    THETA,
    TRUE_DISTANCE,
    TRUE_THETA,
    TURN,
    WORLD,
    Floats,
    Job,
    Setup,
    X,
    Y,
    row,
)
from acsar_gym.vector.kernel.path import judge_path, observe_path


@jit
def judge_goal(state: Floats, i: int, job: Job) -> tuple[float, int]:
    """Reward and outcome of robot i on its way to a goal."""
    x, y = state[ODOM_X, i], state[ODOM_Y, i]
    dx, dy = state[GOAL_X, i] - x, state[GOAL_Y, i] - y
    before, after = state[DISTANCE, i], math.sqrt(dx * dx + dy * dy)
    start = math.sqrt(x * x + y * y)
    touched = state[CONTACT, i] > 0.0
    outcome = goal_outcome(after, start, job.tolerance, job.boundary, touched)
    state[DISTANCE, i] = after
    return goal_reward(before, after, state[LAST_LINEAR, i], outcome, job.end), outcome


@loop
def judge(
    state: Floats,
    rewards: Floats,
    ends: NDArray[np.bool_],
    first: int,
    last: int,
    setup: Setup,
    job: Job,
) -> None:
    """Reward, outcome and time limit after an env step; ends is (terminated, truncated)."""
    for i in range(first, last):
        if job.follows:
            reward, outcome = judge_path(state, i, job)
        else:
            reward, outcome = judge_goal(state, i, job)
        state[OUTCOME, i] = outcome
        state[STEPS, i] += 1.0
        state[RETURN, i] += reward
        rewards[i] = reward
        ends[0, i] = outcome != 0
        ends[1, i] = state[STEPS, i] >= setup.max_steps


@jit
def observe_goal(
    state: Floats, observations: NDArray[np.float32], i: int, setup: Setup, job: Job
) -> None:
    """Robot i's observation on its way to a goal."""
    scales = (job.scale, setup.max_linear, setup.max_angular)
    s, c = sincos(state[ODOM_THETA, i])
    distance, ahead, left = seen_from(
        state[ODOM_X, i], state[ODOM_Y, i], c, s, state[GOAL_X, i], state[GOAL_Y, i]
    )
    twist = (state[LINEAR, i], state[ANGULAR, i])
    o0, o1, o2, o3, o4 = goal_numbers(distance, ahead, left, twist, scales)
    observations[i, 0] = o0
    observations[i, 1] = o1
    observations[i, 2] = o2
    observations[i, 3] = o3
    observations[i, 4] = o4
    observations[i, 5] = state[LAST_LINEAR, i]
    observations[i, 6] = state[LAST_ANGULAR, i]


@loop
def observe(
    state: Floats,
    observations: NDArray[np.float32],
    first: int,
    last: int,
    setup: Setup,
    job: Job,
) -> None:
    """The numbers of every robot's observation; its ranges come with its scans."""
    for i in range(first, last):
        if job.follows:
            observe_path(state, observations, i, setup, job)
        else:
            observe_goal(state, observations, i, setup, job)


@loop
def report(state: Floats, first: int, last: int, setup: Setup, job: Job) -> None:
    """Rows of info that nothing else needs."""
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
        scan_ages(state, first, last, setup)
    if job.scored:
        score(state, first, last, setup, job)


@loop
def scan_ages(state: Floats, first: int, last: int, setup: Setup) -> None:
    """How old every robot's newest scan is [s]."""
    for i in range(first, last):
        age = (state[STEPS, i] * setup.ticks - state[SCAN_TICK, i]) * setup.period
        state[SCAN_AGE, i] = age
        state[STALE, i] = 1.0 if age > setup.stale else 0.0


@loop
def score(state: Floats, first: int, last: int, setup: Setup, job: Job) -> None:
    """BARN's four scores of every robot."""
    for i in range(first, last):
        time = state[STEPS, i] * setup.ticks * setup.period
        given = state[GOAL_GIVEN, i] > 0.0
        length = math.nan if given else job.lengths[int(state[WORLD, i])]
        s0, s1, s2, s3 = scores(state[SUCCESS, i], time, length, setup.max_linear)
        state[SCORE, i], state[SCORE + 1, i] = s0, s1
        state[SCORE + 2, i], state[SCORE + 3, i] = s2, s3
