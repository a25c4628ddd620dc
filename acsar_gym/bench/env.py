"""Benchmarks of environments, batches, codec, odometry and policies; method in `measure`."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from rich.table import Table

from acsar_gym import jit as compiled
from acsar_gym.bench import recording
from acsar_gym.bench import worlds as bench_worlds
from acsar_gym.bench.measure import Figure, each
from acsar_gym.bench.own_task import PlainSmoothGoal, SmoothGoal
from acsar_gym.bench.worlds import crowd
from acsar_gym.config import RobotConfig
from acsar_gym.envs import ObstacleGoalVectorEnv, PointGoalVectorEnv
from acsar_gym.envs.base import RobotEnv
from acsar_gym.errors import AcsarError, MissingExtraError
from acsar_gym.links.simulated import SimulatedLink
from acsar_gym.odometry import Odometry
from acsar_gym.policies import OnnxPolicy
from acsar_gym.protocol import Decoder, encode
from acsar_gym.vector.env import RobotVectorEnv

BLOCKS = 25
ROBOTS = 1024
CROWDS = 64
"""Number of worlds in the batch with obstacles."""
STEPS = 100
"""Env steps in one block."""


OWN_TASKS = (SmoothGoal, PlainSmoothGoal)


def measure(policy: str | None = None) -> list[Figure]:
    """Run all benchmarks.

    Args:
        policy: ONNX policy to measure; None for the packaged one.

    Returns:
        The figures in the order of the table.
    """
    bullet = _bullet()
    single = next(figure.value for figure in bullet if figure.unit == "steps/s")
    return [
        *bullet,
        *_planar(),
        *bench_worlds.measure(),
        *_batch(single),
        *_wire(),
        *recording.measure(),
        *_policy(policy),
    ]


def _env(link: str) -> gymnasium.Env[Any, Any]:
    """Make a PointGoal env and reset it."""
    env = gymnasium.make("acsar_gym/PointGoal-v0", link=link)
    env.reset(seed=0)
    return env


def _steps(env: gymnasium.Env[Any, Any], actions: np.ndarray[Any, Any]) -> float:
    """Measure a tick of random driving, resets included [s]."""
    begin = time.perf_counter()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    ticks = len(actions) * _ticks_per_step(env)
    return (time.perf_counter() - begin) / ticks


def _ticks_per_step(env: gymnasium.Env[Any, Any]) -> int:
    inner = env.unwrapped
    return inner.ticks_per_step if isinstance(inner, RobotEnv) else 1


def _bullet() -> list[Figure]:
    """Compare the whole PyBullet env with the bare stepSimulation calls that it makes."""
    env, other = _env("bullet"), _env("bullet")
    config = RobotConfig.of(None)
    calls = round(config.firmware.loop_rate / config.control_rate)
    bare = _engine(other)
    whole, alone = [], []
    rng = np.random.default_rng(0)
    for _ in range(BLOCKS):
        other.reset()
        other.step(np.array([1.0, 0.3], np.float32))  # so that the bare robot moves, too
        whole.append(_steps(env, rng.uniform(-1.0, 1.0, (STEPS, 2)).astype(np.float32)))
        alone.append(calls * each(bare, 10 * STEPS))
    env.close()
    other.close()
    tick, engine = statistics.median(whole), statistics.median(alone)
    ratio = statistics.median(w / a for w, a in zip(whole, alone, strict=True))
    return [
        Figure("PyBullet: bare stepSimulation calls of a tick", engine * 1e6, "us"),
        Figure("PyBullet: env, wire included, per tick", tick * 1e6, "us"),
        Figure("PyBullet: env against the bare calls", ratio, "x the time"),
        Figure("PyBullet: env speed", config.period / tick, "x real time"),
        Figure("PyBullet: env steps", 1.0 / (tick * _ticks_per_step(env)), "steps/s"),
    ]


def _engine(env: gymnasium.Env[Any, Any]) -> Callable[[], None]:
    """Return a function that makes one bare stepSimulation call."""
    from acsar_gym.bodies.bullet import BulletBody  # noqa: PLC0415 - optional

    inner = env.unwrapped
    link = inner.robot.link if isinstance(inner, RobotEnv) else None
    if not (isinstance(link, SimulatedLink) and isinstance(link.body, BulletBody)):
        raise AcsarError("the bare engine can only be measured behind link='bullet'")
    return link.body.engine_step


def _planar() -> list[Figure]:
    """Measure the single planar env."""
    env = _env("planar")
    rng = np.random.default_rng(0)
    blocks = [
        _steps(env, rng.uniform(-1.0, 1.0, (STEPS, 2)).astype(np.float32)) for _ in range(BLOCKS)
    ]
    tick = statistics.median(blocks)
    period = RobotConfig.of(None).period
    resets = _median(env.reset, 20)
    env.close()
    return [
        Figure("planar: env, wire included, per tick", tick * 1e6, "us"),
        Figure("planar: env speed", period / tick, "x real time"),
        Figure("planar: reset", resets * 1e6, "us"),
    ]


def _batch(single: float) -> list[Figure]:
    """Measure batches: against the PyBullet env (`single` [steps/s]), by cores, and by size."""
    if not compiled.COMPILED:
        return []
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    blind, seeing = PointGoalVectorEnv, ObstacleGoalVectorEnv
    worlds = [crowd(50, 10, seed) for seed in range(CROWDS)]
    among = {"worlds": worlds, "robot": RobotConfig.of(None).with_(lidar={"noise": 0.0})}
    speed, gain = _cores(_stepper(blind, ROBOTS, 1), _stepper(blind, ROBOTS, cores))
    rays, gain_rays = _cores(
        _stepper(seeing, ROBOTS, 1, **among), _stepper(seeing, ROBOTS, cores, **among)
    )
    few, many = _stepper(blind, 16, 1), _stepper(blind, 16384, 1)
    own = [_stepper(partial(RobotVectorEnv, task), ROBOTS, 1) for task in OWN_TASKS]
    compiled_task, plain_task = (ROBOTS / _median(step, 20) for step in own)
    return [
        Figure(f"batch of {ROBOTS} planar robots, one core", speed, "steps/s"),
        Figure("batch against the PyBullet env", speed / single, "x the steps"),
        Figure(f"batch on {cores} cores against one", gain, "x the steps"),
        Figure("batch with 64 rays and 60 obstacles, one core", rays, "steps/s"),
        Figure(f"that batch on {cores} cores against one", gain_rays, "x the steps"),
        Figure("batch with a user's compiled task, one core", compiled_task, "steps/s"),
        Figure("batch with that task in plain Python", plain_task, "steps/s"),
        Figure("batch of 16 robots: one step call", _median(few, 20) * 1e6, "us"),
        Figure("batch of 16,384 robots, a robot", each(many, 5) / 16384 * 1e6, "us"),
    ]


def _cores(one: Callable[[], object], every: Callable[[], object]) -> tuple[float, float]:
    """Return env steps/s on one core, and the speed-up on all cores."""
    alone, together = [], []
    for _ in range(BLOCKS):
        alone.append(each(one, 10) / ROBOTS)
        together.append(each(every, 10) / ROBOTS)
    gain = statistics.median(a / t for a, t in zip(alone, together, strict=True))
    return 1.0 / statistics.median(alone), gain


def _stepper(kind: Callable[..., RobotVectorEnv], robots: int, threads: int, **options: Any) -> Any:
    """Return a function that steps a new batch with random actions."""
    env = kind(robots, max_episode_steps=200, threads=threads, **options)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (robots, 2)).astype(np.float32)
    return lambda: env.step(actions)


def _wire() -> list[Figure]:
    """Measure codec and odometry, with wheel speeds that change in every line."""
    speeds = [tuple(row) for row in np.random.default_rng(0).uniform(-9, 9, (2000, 4)).tolist()]
    lines = [encode(row) for row in speeds]
    decoder, odometry = Decoder(), Odometry(0.05, 0.3)
    return [
        Figure("encode one line", _over(encode, speeds) * 1e6, "us"),
        Figure("decode one line", _over(decoder.feed, lines) * 1e6, "us"),
        Figure(
            "odometry update", _over(lambda row: odometry.update(row, 0.01), speeds) * 1e6, "us"
        ),
    ]


def _policy(policy: str | None) -> list[Figure]:
    """Measure one decision of an ONNX policy."""
    try:
        actor = OnnxPolicy(policy or "point_goal")
    except MissingExtraError:
        return []
    return [_deciding(actor, "")] + ([] if policy else [_deciding(OnnxPolicy("barn"), ", barn")])


def _deciding(actor: OnnxPolicy, name: str) -> Figure:
    """Measure one decision of a policy."""
    observation = np.zeros(actor.width, np.float32)
    took = _median(lambda: actor(observation), 1000)
    return Figure(f"ONNX policy{name}, one decision", took * 1e6, "us")


def _median(call: Callable[[], object], times: int) -> float:
    """Return the median over blocks of the mean duration of a call [s]."""
    return statistics.median(each(call, times) for _ in range(BLOCKS))


def _over(call: Callable[[Any], object], items: list[Any]) -> float:
    """Return the median over blocks of the mean duration of `call` over the items [s]."""

    def once() -> None:
        for item in items:
            call(item)

    return _median(once, 1) / len(items)


def table(figures: list[Figure]) -> Table:
    """Format figures as a table."""
    drawn = Table(title="acsar-gym bench: medians", title_justify="left")
    drawn.add_column("what")
    drawn.add_column("figure", justify="right")
    drawn.add_column("unit")
    for figure in figures:
        digits = 0 if figure.value >= 100 else 2
        drawn.add_row(figure.name, f"{figure.value:,.{digits}f}", figure.unit)
    return drawn
