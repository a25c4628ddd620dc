"""Episodes of a policy, one after the other or as a batch."""

from __future__ import annotations

import math
from collections.abc import Generator
from typing import Any

import gymnasium
import numpy as np

from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import ConfigError, EmergencyStopError
from acsar_gym.links.base import meter_of
from acsar_gym.safety.rules import Reason
from acsar_gym.tools.evaluation import batches
from acsar_gym.tools.evaluation.episode import (
    POSE_KEYS,
    Episode,
    Resets,
    known_pose,
    measure_episode,
)
from acsar_gym.tools.policies import FilePolicy, Policy
from acsar_gym.tools.policies.policy import PolicyContext

MAX_LATE_SHARE = 0.01  # largest share of late ticks in a valid episode


def run_episodes(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    count: int,
    seed: int,
    *,
    in_order: bool = False,
    skip: int = 0,
    late_share: float = MAX_LATE_SHARE,
    **options: Any,
) -> Generator[Episode, None, None]:
    """Run episodes with the seeds `seed`, `seed + 1`, ..., and yield the result of each in order.

    Many episodes of planar robots are driven as a batch, with the same results, where the policy
    has no memory; see `batches`. A fault, or too many late ticks, make an episode not valid; the
    next reset connects again.

    Args:
        env: an env of this package, wrapped or not.
        policy: maps observations to actions; `reset()`, where it has that method, begins an episode
            of it, and `bind` gets the `PolicyContext` of the env, unless `make_env` gave it that.
        count: number of episodes.
        seed: seed of the first reset.
        in_order: use the env's worlds one after the other, instead of random ones.
        skip: with `in_order`, how many of the worlds other calls use before this one.
        late_share: largest share of late ticks in a valid episode, 0 to 1.
        **options: options of every reset.

    Yields:
        The result of each episode.

    Raises:
        ConfigError: there are fewer worlds than episodes with `in_order`, or `late_share` or
            `env` can't be used.
        LinkError: the robot can't be reached.
        EmergencyStopError: its emergency stop was used.
    """
    pool = getattr(env.unwrapped, "pool", None)
    worlds = range(0) if pool is None else pool.numbers
    if in_order and len(worlds) < skip + count:
        raise ConfigError(
            f"{skip + count} episodes in order need as many worlds, but there are {len(worlds)}"
        )
    resets = [
        (seed + number, options | ({"world": worlds[skip + number]} if in_order else {}))
        for number in range(count)
    ]
    return run_resets(env, policy, resets, late_share)


def run_resets(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    resets: Resets,
    late_share: float = MAX_LATE_SHARE,
) -> Generator[Episode, None, None]:
    """As `run_episodes`, with these seeds and options."""
    if not 0.0 <= late_share <= 1.0:
        raise ConfigError(f"late_share = {late_share!r}: must be a share, 0 to 1")
    inner = env.unwrapped
    if not isinstance(inner, RobotEnv):
        raise ConfigError(f"{env}: only environments of acsar_gym can be evaluated")
    if not isinstance(policy, FilePolicy) and (bind := getattr(policy, "bind", None)) is not None:
        bind(PolicyContext.of(inner))
    if batches.can_batch(env, policy, resets):
        yield from batches.run_batch(env, policy, resets)
        return
    for seed, options in resets:
        yield _run_episode(env, inner, policy, seed, dict(options), late_share)


def _run_episode(
    env: gymnasium.Env[Any, Any],
    inner: RobotEnv,
    policy: Policy,
    seed: int,
    options: dict[str, Any],
    late_share: float,
) -> Episode:
    """Run one episode, stop the robot, and compute the result."""
    robot = inner.robot
    if (meter := meter_of(robot.link)) is not None:
        meter.metered = True
    observation, info = env.reset(seed=seed, options=options)
    if (begin := getattr(policy, "reset", None)) is not None:
        begin()
    poses, rewards, done = [[info[key] for key in POSE_KEYS]], 0.0, False
    way = inner.episode.shortest_path(known_pose(poses[0]))  # measured later: a robot doesn't wait
    while not done:
        observation, reward, terminated, truncated, info = env.step(policy(observation))
        poses.append([info[key] for key in POSE_KEYS])
        rewards += float(reward)
        if robot.safety.reason is Reason.EMERGENCY_STOP:
            raise EmergencyStopError
        done = terminated or truncated
    timing, meter = robot.timing, meter_of(robot.link)
    fault = info.get("fault_reason", "")
    late = timing.lateness.late_share if timing else 0.0
    length, track = len(poses) - 1, np.array(poses, np.float64)
    return Episode(
        seed=seed,
        fault=fault,
        valid=not fault and late <= late_share,
        started=robot.wire.began,
        ended=robot.wire.stamp,
        length=length,
        ticks=length * inner.ticks_per_step,
        late_ticks=timing.lateness.late_ticks if timing else 0,
        episode_return=rewards,
        energy=math.nan if meter is None else meter.work,
        timing=timing,
        **measure_episode(inner, inner.episode, track, info, way),
    )
