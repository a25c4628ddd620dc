"""Benchmarks of rays, environments with obstacles, and pictures; method in `measure`."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from acsar_gym.bench.measure import Figure, alternating, each
from acsar_gym.config import RobotConfig
from acsar_gym.envs.base import RobotEnv
from acsar_gym.lidars.base import ray_spec
from acsar_gym.render.top_view import Frame, TopView
from acsar_gym.worlds import Region, Scene, World
from acsar_gym.worlds.geometry import Obstacles, cast, surroundings

BLOCKS = 15
STEPS = 60
"""Env steps in one block."""
POINTS = 500
"""Points of each path in the pictures."""


def crowd(circles: int, segments: int, seed: int = 0) -> World:
    """Make a world with obstacles all around its start, at least 1.5 m away."""
    rng = np.random.default_rng(seed)
    count = circles + segments
    bearing, turn = rng.uniform(-math.pi, math.pi, (2, count))
    distance = rng.uniform(1.5, 6.0, count)
    x, y = distance * np.cos(bearing), distance * np.sin(bearing)
    radius = rng.uniform(0.1, 0.3, count)
    ends = np.column_stack([x, y, x + 0.5 * np.cos(turn), y + 0.5 * np.sin(turn)])
    return World(
        np.column_stack([x, y, radius])[:circles],
        ends[circles:],
        Region(0.0, 0.0, 0.0, 0.0),
        Region(0.5, 0.0),
        np.array([[0.0, 0.0], [0.5, 0.0]]),
    )


def measure() -> list[Figure]:
    """Run the benchmarks of this module; figures in the order of the table."""
    return [*_rays(), *_bullet(), *_pictures()]


def _rays() -> list[Figure]:
    """Compare 64 rays among 100 obstacles with PyBullet's."""
    from acsar_gym.bodies.bullet import BulletBody  # noqa: PLC0415 - optional

    config, world = RobotConfig.of(None), crowd(80, 20)
    around = surroundings(Obstacles(world.circles, world.segments), ray_spec(config), 1, config)
    body, ranges = BulletBody(config), np.empty(config.lidar.rays)
    body.reset(Scene(world=world))
    angles, reach = ray_spec(config).angles(), config.lidar.max_range
    ours, theirs, ratio = alternating(
        lambda: each(lambda: cast(0.0, 0.0, 1.0, 0.0, 0, around, ranges), 200),
        lambda: each(lambda: body.rays((0.0, 0.0), angles, reach), 20),
        BLOCKS,
    )
    body.close()
    return [
        Figure("64 rays among 100 obstacles", ours * 1e6, "us"),
        Figure("the same by PyBullet's rayTestBatch", theirs * 1e6, "us"),
        Figure("rayTestBatch against ours", ratio, "x the time"),
    ]


def _env(world: World) -> gymnasium.Env[Any, Any]:
    """Make an ObstacleGoal env in PyBullet and reset it."""
    env = gymnasium.make("acsar_gym/ObstacleGoal-v1", link="bullet", worlds=world)
    env.reset(seed=0)
    return env


def _tick(env: gymnasium.Env[Any, Any]) -> Callable[[], float]:
    """Return a function that measures a tick of random driving near the start [s]."""
    inner = env.unwrapped
    ticks = inner.ticks_per_step if isinstance(inner, RobotEnv) else 1
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (STEPS, 2)).astype(np.float32)

    def block() -> float:
        """Measure one block."""
        env.reset(seed=0)
        begin = time.perf_counter()
        for action in actions:
            inner.step(action)
        return (time.perf_counter() - begin) / (STEPS * ticks)

    return block


def _bullet() -> list[Figure]:
    """Measure the whole PyBullet env among obstacles, serial protocol and LiDAR included."""
    period = RobotConfig.of(None).period
    envs = [_env(crowd(0, 0)), _env(crowd(50, 10)), _env(crowd(250, 50))]
    empty, some, _ = alternating(_tick(envs[0]), _tick(envs[1]), BLOCKS)
    _, _, ratio = alternating(_tick(envs[2]), _tick(envs[0]), BLOCKS, of_first=True)
    for env in envs:
        env.close()
    return [
        Figure("PyBullet ObstacleGoal, empty world", period / empty, "x real time"),
        Figure("PyBullet ObstacleGoal, 64 rays, 60 obstacles", period / some, "x real time"),
        Figure("PyBullet ObstacleGoal, 300 obstacles against none", ratio, "x the time"),
    ]


def _pictures() -> list[Figure]:
    """Measure top views of 480 x 480 pixels with all elements."""
    config, world = RobotConfig.of(None), crowd(250, 50)
    view, turns = TopView(config, (480, 480)), np.linspace(0.0, 6.0, POINTS)
    way = np.column_stack([turns / 3.0, np.sin(turns)]).tolist()
    frame = Frame(
        world=world,
        odom=(2.0, 0.0, 0.3),
        truth=(2.02, 0.05, 0.32),
        goal=(3.0, 1.0),
        odom_path=way,
        true_path=[(x, y + 0.05) for x, y in way],
        rays=(ray_spec(config).angles(), np.linspace(1.0, 4.0, config.lidar.rays)),
        reach=config.lidar.max_range,
    )
    view.draw(frame)
    seconds = statistics.median(each(lambda: view.draw(frame), 20) for _ in range(BLOCKS))
    return [Figure("top view of 480 x 480 pixels", 1.0 / seconds, "frames/s")]
