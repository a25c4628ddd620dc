"""Measure the speed of envs, batches, rays, pictures, codec, recordings and policies: `make bench`.

The speed of a machine drifts. So things that are compared run in alternating blocks, figures are
medians over the blocks, and ratios are medians of the ratios of neighbouring blocks.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from statistics import median
from typing import Any

import gymnasium
import numpy as np
from rich.console import Console
from rich.table import Table

from acsar_gym.config import RobotConfig
from acsar_gym.envs import ObstacleGoalVectorEnv, PointGoalVectorEnv
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.links import open_link
from acsar_gym.physics.bullet import BulletBody
from acsar_gym.protocol import Decoder, encode
from acsar_gym.recording import Recorder
from acsar_gym.render.top_view import TopView, TopViewFrame
from acsar_gym.robot import Robot
from acsar_gym.sensors import SensorInput
from acsar_gym.sensors.map.sensor import find_map
from acsar_gym.tasks import Outcome, State, Task
from acsar_gym.tools.policies import OnnxPolicy
from acsar_gym.vector.env import RobotVectorEnv
from acsar_gym.vector.threads import usable_cores
from acsar_gym.worlds import Region, Scene, World
from acsar_gym.worlds.geometry import cast_lines, make_surroundings
from acsar_gym.worlds.movers import Mover, walk

BLOCKS = 25
ENV_STEPS = 100
"""Env steps in one block."""
BATCH_ROBOTS = 1024
MOVER_ROBOTS = 512
MOVERS = 20
"""Movers around each robot."""
WORLDS = 64
"""Worlds of a batch with obstacles."""

Figure = tuple[str, float, str]
"""What is measured, the number and its unit."""
Measurement = Callable[[], float]
"""Runs one block, and returns seconds."""


def mean_duration(call: Callable[[], object], times: int) -> float:
    """Return the mean duration of `times` calls [s]."""
    start = time.perf_counter()
    for _ in range(times):
        call()
    return (time.perf_counter() - start) / times


def median_duration(call: Callable[[], object], times: int) -> float:
    """Return the median over blocks of the mean duration of `times` calls [s]."""
    return median(mean_duration(call, times) for _ in range(BLOCKS))


def alternate(first: Measurement, second: Measurement) -> tuple[float, float, float]:
    """Run two measurements in turn, and return both medians, and that of first / second."""
    first()
    second()
    pairs = [(first(), second()) for _ in range(BLOCKS)]
    firsts, seconds = zip(*pairs, strict=True)
    return median(firsts), median(seconds), median(a / b for a, b in pairs)


def crowded_world(circles: int, segments: int, seed: int = 0) -> World:
    """Make a world with obstacles all around its start, at least 1.5 m away."""
    rng = np.random.default_rng(seed)
    count = circles + segments

    bearing, turn = rng.uniform(-math.pi, math.pi, (2, count))
    distance = rng.uniform(1.5, 6.0, count)
    x = distance * np.cos(bearing)
    y = distance * np.sin(bearing)
    radius = rng.uniform(0.1, 0.3, count)
    ends = np.column_stack([x, y, x + 0.5 * np.cos(turn), y + 0.5 * np.sin(turn)])
    return World(
        circles=np.column_stack([x, y, radius])[:circles],
        segments=ends[circles:],
        start=Region(0.0, 0.0, 0.0, 0.0),
        goal=Region(0.5, 0.0),
        path=np.array([[0.0, 0.0], [0.5, 0.0]]),
    )


def make_walkers(seed: int) -> list[Mover]:
    """Draw people who walk there and back, past the start of `crowded_world` at 1 m or more."""
    rng = np.random.default_rng(seed)
    walkers: list[Mover] = []
    while len(walkers) < MOVERS:
        walker = walk(rng.uniform(-6.0, 6.0, (4, 2)), rng.uniform(0.4, 1.6))
        times = np.linspace(0.0, walker.duration, 100).tolist()
        if min(math.hypot(*walker.position(time)) for time in times) > 1.0:
            walkers.append(walker)
    return walkers


def make_env(env_id: str, link: str, **options: Any) -> gymnasium.Env[Any, Any]:
    """Make an env, and reset it."""
    env = gymnasium.make(f"acsar_gym/{env_id}", link=link, **options)
    env.reset(seed=0)
    return env


def drive_randomly(env: gymnasium.Env[Any, Any]) -> float:
    """Drive a block with random actions, resets included, and return the duration of a step [s]."""
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (ENV_STEPS, 2)).astype(np.float32)
    start = time.perf_counter()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    return (time.perf_counter() - start) / ENV_STEPS


def measure_envs() -> Iterator[Figure]:
    """Measure single envs, serial protocol included, without obstacles and with them."""
    config = RobotConfig.of(None)
    for name, link in (("PyBullet", "bullet"), ("planar", "planar")):
        env = make_env("PointGoal-v0", link)
        inner: Any = env.unwrapped
        tick = median(drive_randomly(env) for _ in range(BLOCKS)) / inner.ticks_per_step
        yield f"{name}: env, wire included, per tick", tick * 1e6, "us"
        yield f"{name}: env speed", config.period / tick, "x real time"

    env = make_env("ObstacleGoal-v1", "bullet", worlds=crowded_world(50, 10))
    step = median(drive_randomly(env) for _ in range(BLOCKS))
    speed = inner.ticks_per_step * config.period / step
    yield "PyBullet ObstacleGoal, 64 rays, 60 obstacles", speed, "x real time"


def measure_rays() -> Iterator[Figure]:
    """Compare 64 rays among 100 obstacles with PyBullet's."""
    config = RobotConfig.of(None)
    world = crowded_world(80, 20)
    around = make_surroundings(world, ray_spec(config), config)
    ranges = np.empty(config.lidar.rays)
    origins = np.zeros((config.lidar.rays, 2))
    body = BulletBody(config)
    body.reset(Scene(world=world))

    angles = ray_spec(config).angles()
    reach = config.lidar.max_range
    height = config.lidar_z_offset
    starts = [(0.0, 0.0, height)] * len(angles)
    ends = [(reach * math.cos(angle), reach * math.sin(angle), height) for angle in angles]
    pose = (0.0, 0.0, 1.0, 0.0)
    cast = partial(cast_lines, *pose, 0, around, origins, ranges)
    test = partial(body._engine.rayTestBatch, starts, ends)
    _, ours, ratio = alternate(partial(mean_duration, test, 20), partial(mean_duration, cast, 200))
    body.close()
    yield "64 rays among 100 obstacles", ours * 1e6, "us"
    yield "rayTestBatch against ours", ratio, "x the time"


def measure_pictures() -> Iterator[Figure]:
    """Measure top views of 480 x 480 pixels with all elements."""
    config = RobotConfig.of(None)
    view = TopView(config, (480, 480))
    turns = np.linspace(0.0, 6.0, 500)
    path = np.column_stack([turns / 3.0, np.sin(turns)]).tolist()

    frame = TopViewFrame(
        world=crowded_world(250, 50),
        odom=(2.0, 0.0, 0.3),
        truth=(2.02, 0.05, 0.32),
        goal=(3.0, 1.0),
        odom_path=path,
        true_path=[(x, y + 0.05) for x, y in path],
        rays=(ray_spec(config).angles(), np.linspace(1.0, 4.0, config.lidar.rays)),
        reach=config.lidar.max_range,
    )
    view.draw(frame)
    seconds = median_duration(partial(view.draw, frame), 20)
    yield "top view of 480 x 480 pixels", 1.0 / seconds, "frames/s"


class OwnGoal(Task):
    """A user's compiled task: reach the goal."""

    observation = {"x": (-20.0, 20.0), "y": (-20.0, 20.0)}  # noqa: RUF012
    memory = {"distance": 0.0}  # noqa: RUF012
    compiled = True

    def outcome(self, state: State, memory: Any) -> Outcome:
        """Success near the goal."""
        distance = math.hypot(state.goal[0] - state.pose[0], state.goal[1] - state.pose[1])
        return Outcome.SUCCESS if distance < 0.2 else Outcome.GOING

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Metres gained, less the work of turning."""
        distance = math.hypot(state.goal[0] - state.pose[0], state.goal[1] - state.pose[1])
        gain: float = memory.distance - distance - 0.01 * abs(state.twist[1])
        memory.distance = distance
        return gain

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        """The goal, seen from the robot."""
        return state.goal[0] - state.pose[0], state.goal[1] - state.pose[1]


def step_batch(
    kind: Callable[..., RobotVectorEnv], robots: int, threads: int = 1, **options: Any
) -> Measurement:
    """Return a measurement of a step of a new batch with random actions."""
    env = kind(robots, max_episode_steps=200, threads=threads, **options)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (robots, 2)).astype(np.float32)
    return partial(mean_duration, partial(env.step, actions), 10)


def measure_batches() -> Iterator[Figure]:
    """Measure batches on one core and on all cores, and against the PyBullet env."""
    robots = BATCH_ROBOTS
    cores = usable_cores()
    worlds = [crowded_world(50, 10, seed) for seed in range(WORLDS)]
    kinds: list[tuple[str, str, Callable[..., RobotVectorEnv]]] = [
        (f"batch of {robots} planar robots, one core", "batch", PointGoalVectorEnv),
        (
            "batch with 64 rays and 60 obstacles, one core",
            "that batch",
            partial(ObstacleGoalVectorEnv, worlds=worlds),
        ),
    ]
    for name, short_name, kind in kinds:
        step, _, gain = alternate(step_batch(kind, robots), step_batch(kind, robots, cores))
        yield name, robots / step, "steps/s"
        yield f"{short_name} on {cores} cores against one", gain, "x the steps"

    blind = step_batch(PointGoalVectorEnv, robots)
    single = make_env("PointGoal-v0", "bullet")
    ratio = alternate(partial(drive_randomly, single), blind)[2]
    own_task = step_batch(partial(RobotVectorEnv, OwnGoal), robots)
    own_step = median(own_task() for _ in range(BLOCKS))
    yield "PyBullet: env steps", 1.0 / drive_randomly(single), "steps/s"
    yield "batch against the PyBullet env", ratio * robots, "x the steps"
    yield "batch with a user's compiled task, one core", robots / own_step, "steps/s"

    walkers = [replace(world, movers=make_walkers(seed)) for seed, world in enumerate(worlds)]
    among = step_batch(partial(ObstacleGoalVectorEnv, worlds=walkers), MOVER_ROBOTS)
    step = median(among() for _ in range(BLOCKS))
    yield f"batch of {MOVER_ROBOTS}, {MOVERS} walkers, one core", MOVER_ROBOTS / step, "steps/s"


def measure_wire() -> Iterator[Figure]:
    """Measure the codec, with wheel speeds that change in every line."""
    speeds = np.random.default_rng(0).uniform(-9.0, 9.0, (2000, 4)).tolist()
    lines = [encode(row) for row in speeds]
    decoder = Decoder()
    encoding = median_duration(lambda: [encode(row) for row in speeds], 1)
    decoding = median_duration(lambda: [decoder.feed(line) for line in lines], 1)
    yield "encode one line", encoding / len(lines) * 1e6, "us"
    yield "decode one line", decoding / len(lines) * 1e6, "us"


def measure_recording() -> Iterator[Figure]:
    """Compare ticks of the planar robot with a scan in every tick, with and without recording.

    Only the processor time of the control loop's own thread counts.
    """
    config = RobotConfig.of(None).with_(lidar={"rays": 360, "rate": 100.0})

    def measure_tick(robot: Robot) -> float:
        start = time.thread_time()
        for _ in range(ENV_STEPS):
            robot.drive(0.3, 0.2)
        spent = time.thread_time() - start
        time.sleep(0.05)  # the writer catches up
        return spent / ENV_STEPS

    with tempfile.TemporaryDirectory() as folder:
        bare, recorded = (
            Robot(open_link("planar", config), config, ["lidar"], recorder)
            for recorder in (None, Recorder(Path(folder) / "bench.mcap"))
        )
        with bare, recorded:
            pairs = [(measure_tick(bare), measure_tick(recorded)) for _ in range(BLOCKS)]
    without, recording = (min(times) for times in zip(*pairs, strict=True))
    yield "recording, per tick, on the loop's thread", max(recording - without, 1e-9) * 1e6, "us"


def measure_policies() -> Iterator[Figure]:
    """Measure a decision of a packaged policy, and an update of the map during a drive."""
    policy = OnnxPolicy("point_goal")
    decide = partial(policy, np.zeros(policy.width, np.float32))
    yield "ONNX policy, one decision", median_duration(decide, 1000) * 1e6, "us"

    policy = OnnxPolicy("obstacle_goal")
    env = make_env("ObstacleGoal-v1", "planar", worlds="clutter:1-20")
    inner: Any = env.unwrapped
    sensor = find_map(inner.robot.sensors)
    assert sensor is not None
    nowhere = np.full((1, 3), np.nan)
    robots = SensorInput(nowhere, nowhere, nowhere, np.zeros(1), scenes=(), rngs=(), memory=None)
    update = partial(sensor.read, robots, np.zeros((1, sensor.size)))
    updates = []
    observation, _ = env.reset(seed=0)
    for _ in range(3 * ENV_STEPS):
        observation, _, terminated, truncated, _ = env.step(policy(observation))
        updates.append(mean_duration(update, 1))
        if terminated or truncated:
            observation, _ = env.reset()
    yield "map, one update", float(np.mean(updates)) * 1e6, "us"


MEASUREMENTS = (
    measure_envs,
    measure_rays,
    measure_pictures,
    measure_batches,
    measure_wire,
    measure_recording,
    measure_policies,
)


def make_table(figures: Iterable[Figure]) -> Table:
    """Format figures as a table."""
    table = Table("what", title="make bench: medians", title_justify="left")
    table.add_column("figure", justify="right")
    table.add_column("unit")
    for name, value, unit in figures:
        table.add_row(name, f"{value:,.{0 if value >= 100 else 2}f}", unit)
    return table


if __name__ == "__main__":
    Console().print(make_table(chain.from_iterable(measure() for measure in MEASUREMENTS)))
