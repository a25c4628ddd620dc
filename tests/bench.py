"""How fast it all is: environments, batches, rays, pictures, codec, recordings and policies.

`make bench` prints the table of docs/performance.md. The speed of a machine drifts. So things that
are compared run in alternating blocks, figures are medians over the blocks, and ratios are medians
of the ratios of neighbouring blocks.
"""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pybullet
from rich.console import Console
from rich.table import Table

from acsar_gym.config import RobotConfig
from acsar_gym.envs import ObstacleGoalVectorEnv, PointGoalVectorEnv
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.links import open_link
from acsar_gym.odometry import Odometry
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

ENV_BLOCKS = 25
ENV_STEPS = 100
"""Env steps in one block."""
BATCH_ROBOTS = 1024
BATCH_WORLDS = 64
"""Number of worlds in the batch with obstacles."""
MOVER_ROBOTS, MOVERS = 512, 20
"""Robots of the batch among movers, and movers around each."""
PATH_POINTS = 500
"""Points of each path in the pictures."""
RECORDING_TICKS = 100
"""Ticks of one block, after which the writer catches up for RECORDING_BREAK [s]."""
RECORDING_BREAK = 0.05
MAP_STEPS = 300
"""Updates of the map of which the mean is taken."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured number."""

    name: str
    value: float
    unit: str


def measure_all() -> list[Figure]:
    """Run all benchmarks; figures in the order of the table."""
    bullet = _measure_bullet()
    single = next(figure.value for figure in bullet if figure.unit == "steps/s")
    return [
        *bullet,
        *_measure_planar(),
        *_measure_rays(),
        *_measure_obstacles(),
        *_measure_pictures(),
        *_measure_batches(single),
        *_measure_movers(),
        *_measure_wire(),
        *_measure_recording(),
        *_measure_policies(),
    ]


def figure_table(figures: list[Figure]) -> Table:
    """Format figures as a table."""
    drawn = Table(title="make bench: medians", title_justify="left")
    drawn.add_column("what")
    drawn.add_column("figure", justify="right")
    drawn.add_column("unit")
    for figure in figures:
        digits = 0 if figure.value >= 100 else 2
        drawn.add_row(figure.name, f"{figure.value:,.{digits}f}", figure.unit)
    return drawn


def mean_duration(call: Callable[[], object], times: int) -> float:
    """Return the mean duration of `times` calls [s]."""
    begin = time.perf_counter()
    for _ in range(times):
        call()
    return (time.perf_counter() - begin) / times


def median_duration(call: Callable[[], object], times: int) -> float:
    """Return the median over blocks of the mean duration of `times` calls [s]."""
    return statistics.median(mean_duration(call, times) for _ in range(ENV_BLOCKS))


def measure_alternating(
    one: Callable[[], float], other: Callable[[], float], blocks: int, *, of_first: bool = False
) -> tuple[float, float, float]:
    """Run two measurements alternately.

    Args:
        one: the first measurement, returns seconds.
        other: the second one.
        blocks: number of pairs, after a warm-up.
        of_first: return the ratio first / second instead of second / first.

    Returns:
        Medians of both, and the median of the ratios.
    """
    one()
    other()
    pairs = [(one(), other()) for _ in range(blocks)]
    first, second = (statistics.median(column) for column in zip(*pairs, strict=True))
    ratios = [a / b if of_first else b / a for a, b in pairs]
    return first, second, statistics.median(ratios)


@dataclass(frozen=True)
class SmoothGoal(Task):
    """Reach a point of an open floor without turning more than needed."""

    weight: float = 0.2
    observation: ClassVar[Mapping[str, tuple[float, float]]] = {
        "ahead": (-20.0, 20.0),
        "left": (-20.0, 20.0),
        "linear": (-2.0, 2.0),
        "angular": (-4.0, 4.0),
    }
    memory: ClassVar[Mapping[str, float]] = {"distance": 0.0, "turned": 0.0, "before": 0.0}
    compiled = True

    def begin(self, state: State, memory: Any) -> None:
        """Note the distance to the goal."""
        memory.distance = math.hypot(state.goal[0], state.goal[1])

    def outcome(self, state: State, memory: Any) -> Outcome:
        """Success within the tolerance."""
        dx, dy = state.goal[0] - state.pose[0], state.goal[1] - state.pose[1]
        return Outcome.SUCCESS if math.hypot(dx, dy) < self.goal_tolerance else Outcome.GOING

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Metres gained, less changes of the action and turns that weren't asked for."""
        dx, dy = state.goal[0] - state.pose[0], state.goal[1] - state.pose[1]
        before, memory.distance = memory.distance, math.hypot(dx, dy)
        change, memory.before = abs(state.action[1] - memory.before), state.action[1]
        memory.turned += abs(state.twist[1]) * state.period
        lag = abs(state.sent[1] - state.twist[1])
        worth: float = before - memory.distance - self.weight * change - 0.01 * lag
        return worth

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        """The goal in the robot's frame, and its velocities."""
        x, y, theta = state.pose
        dx, dy = state.goal[0] - x, state.goal[1] - y
        cos, sin = math.cos(theta), math.sin(theta)
        return dx * cos + dy * sin, dy * cos - dx * sin, state.twist[0], state.twist[1]


def crowd_world(circles: int, segments: int, seed: int = 0) -> World:
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


def make_simulated(env_id: str, link: str, **options: Any) -> gymnasium.Env[Any, Any]:
    """Make an env and reset it."""
    env = gymnasium.make(f"acsar_gym/{env_id}", link=link, **options)
    env.reset(seed=0)
    return env


def _drive_randomly(env: gymnasium.Env[Any, Any]) -> float:
    """Measure a tick of a block of random driving, resets included [s]."""
    inner: Any = env.unwrapped
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (ENV_STEPS, 2)).astype(np.float32)
    begin = time.perf_counter()
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()
    took: float = (time.perf_counter() - begin) / (ENV_STEPS * inner.ticks_per_step)
    return took


def _measure_bullet() -> list[Figure]:
    """Compare the whole PyBullet env with the bare stepSimulation calls that it makes."""
    env, other = (make_simulated("PointGoal-v0", "bullet") for _ in range(2))
    inner: Any = other.unwrapped
    config = RobotConfig.of(None)
    calls = round(config.firmware.loop_rate / config.control_rate)
    bare = partial(pybullet.stepSimulation, inner.robot.link.body._engine.number)

    def drive_bare() -> float:
        other.reset()
        other.step(np.array([1.0, 0.3], np.float32))  # so that the bare robot moves, too
        return calls * mean_duration(bare, 10 * ENV_STEPS)

    tick, engine, ratio = measure_alternating(
        lambda: _drive_randomly(env), drive_bare, ENV_BLOCKS, of_first=True
    )
    env.close()
    other.close()
    return [
        Figure("PyBullet: bare stepSimulation calls of a tick", engine * 1e6, "us"),
        Figure("PyBullet: env, wire included, per tick", tick * 1e6, "us"),
        Figure("PyBullet: env against the bare calls", ratio, "x the time"),
        Figure("PyBullet: env speed", config.period / tick, "x real time"),
        Figure("PyBullet: env steps", 1.0 / (tick * inner.ticks_per_step), "steps/s"),
    ]


def _measure_planar() -> list[Figure]:
    """Measure the single planar env."""
    env = make_simulated("PointGoal-v0", "planar")
    tick = statistics.median(_drive_randomly(env) for _ in range(ENV_BLOCKS))
    resets = median_duration(env.reset, 20)
    env.close()
    return [
        Figure("planar: env, wire included, per tick", tick * 1e6, "us"),
        Figure("planar: env speed", RobotConfig.of(None).period / tick, "x real time"),
        Figure("planar: reset", resets * 1e6, "us"),
    ]


def _measure_rays() -> list[Figure]:
    """Compare 64 rays among 100 obstacles with PyBullet's."""
    config, world = RobotConfig.of(None), crowd_world(80, 20)
    around = make_surroundings(world, ray_spec(config), config)
    body, ranges = BulletBody(config), np.empty(config.lidar.rays)
    origins = np.zeros((config.lidar.rays, 2))
    body.reset(Scene(world=world))
    angles, reach = ray_spec(config).angles(), config.lidar.max_range
    height = config.lidar_z_offset
    starts = [(0.0, 0.0, height)] * len(angles)
    ends = [(reach * math.cos(angle), reach * math.sin(angle), height) for angle in angles]
    ours, theirs, ratio = measure_alternating(
        lambda: mean_duration(
            lambda: cast_lines(0.0, 0.0, 1.0, 0.0, 0, around, origins, ranges), 200
        ),
        lambda: mean_duration(lambda: body._engine.rayTestBatch(starts, ends), 20),
        ENV_BLOCKS,
    )
    body.close()
    return [
        Figure("64 rays among 100 obstacles", ours * 1e6, "us"),
        Figure("the same by PyBullet's rayTestBatch", theirs * 1e6, "us"),
        Figure("rayTestBatch against ours", ratio, "x the time"),
    ]


def _measure_obstacles() -> list[Figure]:
    """Measure the whole PyBullet env among obstacles, serial protocol and LiDAR included."""
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (60, 2)).astype(np.float32)
    envs = [
        make_simulated("ObstacleGoal-v1", "bullet", worlds=crowd_world(*counts))
        for counts in ((0, 0), (50, 10), (250, 50))
    ]

    def drive_near_start(env: gymnasium.Env[Any, Any]) -> float:
        """Measure a tick of a block of random driving near the start [s]."""
        inner: Any = env.unwrapped
        took, has_ended = 0.0, True
        for action in actions:
            if has_ended:
                env.reset(seed=0)
            begin = time.perf_counter()
            _, _, has_ended, _, _ = inner.step(action)
            took += time.perf_counter() - begin
        return took / (len(actions) * int(inner.ticks_per_step))

    bare, some, many = (partial(drive_near_start, env) for env in envs)
    empty, crowded, _ = measure_alternating(bare, some, ENV_BLOCKS)
    _, _, ratio = measure_alternating(many, bare, ENV_BLOCKS, of_first=True)
    for env in envs:
        env.close()
    period = RobotConfig.of(None).period
    return [
        Figure("PyBullet ObstacleGoal, empty world", period / empty, "x real time"),
        Figure("PyBullet ObstacleGoal, 64 rays, 60 obstacles", period / crowded, "x real time"),
        Figure("PyBullet ObstacleGoal, 300 obstacles against none", ratio, "x the time"),
    ]


def _measure_pictures() -> list[Figure]:
    """Measure top views of 480 x 480 pixels with all elements."""
    config, world = RobotConfig.of(None), crowd_world(250, 50)
    view, turns = TopView(config, (480, 480)), np.linspace(0.0, 6.0, PATH_POINTS)
    way = np.column_stack([turns / 3.0, np.sin(turns)]).tolist()
    frame = TopViewFrame(
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
    seconds = median_duration(lambda: view.draw(frame), 20)
    return [Figure("top view of 480 x 480 pixels", 1.0 / seconds, "frames/s")]


def _measure_batches(single: float) -> list[Figure]:
    """Measure batches: against the PyBullet env (`single` [steps/s]), by cores, and by size."""

    def make_stepper(
        kind: Callable[..., RobotVectorEnv], robots: int, threads: int = 1, **options: Any
    ) -> Callable[[], object]:
        """Return a function that steps a new batch with random actions."""
        env = kind(robots, max_episode_steps=200, threads=threads, **options)
        env.reset(seed=0)
        actions = np.random.default_rng(0).uniform(-1.0, 1.0, (robots, 2)).astype(np.float32)
        return lambda: env.step(actions)

    def measure_cores(kind: Callable[..., RobotVectorEnv], **options: Any) -> tuple[float, float]:
        """Return env steps/s on one core, and the speed-up on all cores."""
        one = make_stepper(kind, BATCH_ROBOTS, **options)
        every = make_stepper(kind, BATCH_ROBOTS, cores, **options)
        alone, _, gain = measure_alternating(
            lambda: mean_duration(one, 10),
            lambda: mean_duration(every, 10),
            ENV_BLOCKS,
            of_first=True,
        )
        return BATCH_ROBOTS / alone, gain

    cores = usable_cores()
    blind, seeing = PointGoalVectorEnv, ObstacleGoalVectorEnv
    worlds = [crowd_world(50, 10, seed) for seed in range(BATCH_WORLDS)]
    speed, gain = measure_cores(blind)
    rays, gain_rays = measure_cores(
        seeing, worlds=worlds, robot=RobotConfig.of(None).with_(lidar={"noise": 0.0})
    )
    few, many = make_stepper(blind, 16), make_stepper(blind, 16384)
    own_task = make_stepper(partial(RobotVectorEnv, SmoothGoal), BATCH_ROBOTS)
    own_speed = BATCH_ROBOTS / median_duration(own_task, 20)
    return [
        Figure(f"batch of {BATCH_ROBOTS} planar robots, one core", speed, "steps/s"),
        Figure("batch against the PyBullet env", speed / single, "x the steps"),
        Figure(f"batch on {cores} cores against one", gain, "x the steps"),
        Figure("batch with 64 rays and 60 obstacles, one core", rays, "steps/s"),
        Figure(f"that batch on {cores} cores against one", gain_rays, "x the steps"),
        Figure("batch with a user's compiled task, one core", own_speed, "steps/s"),
        Figure("batch of 16 robots: one step call", median_duration(few, 20) * 1e6, "us"),
        Figure("batch of 16,384 robots, a robot", mean_duration(many, 5) / 16384 * 1e6, "us"),
    ]


def _measure_movers() -> list[Figure]:
    """Measure ObstacleGoal's batch among walkers, and among people who react, against none."""

    def make_stepper(reacts: bool | None) -> Callable[[], float]:
        """Return a function that measures a step; None is without movers."""
        worlds = [crowd_world(50, 10, seed) for seed in range(BATCH_WORLDS)]
        if reacts is not None:
            worlds = [
                replace(world, movers=draw_walkers(MOVERS, reacts, seed))
                for seed, world in enumerate(worlds)
            ]
        env = ObstacleGoalVectorEnv(MOVER_ROBOTS, worlds=worlds, threads=1)
        env.reset(seed=0)
        actions = np.random.default_rng(0).uniform(-1.0, 1.0, (MOVER_ROBOTS, 2))
        return lambda: mean_duration(lambda: env.step(actions.astype(np.float32)), 10)

    bare, walkers, people = make_stepper(None), make_stepper(False), make_stepper(True)
    _, step, among_walkers = measure_alternating(bare, walkers, ENV_BLOCKS, of_first=True)
    _, _, among_people = measure_alternating(bare, people, ENV_BLOCKS, of_first=True)
    size = f"batch of {MOVER_ROBOTS}, {MOVERS}"
    return [
        Figure(f"{size} walkers, one core", MOVER_ROBOTS / step, "steps/s"),
        Figure(f"{size} walkers against none", among_walkers, "x the steps"),
        Figure(f"{size} people who react against none", among_people, "x the steps"),
    ]


def draw_walkers(count: int, reacts: bool, seed: int) -> list[Mover]:
    """Draw people who walk there and back, past the start of `crowd_world` at 1 m or more."""
    rng = np.random.default_rng(seed)
    walkers: list[Mover] = []
    while len(walkers) < count:
        walker = walk(rng.uniform(-6.0, 6.0, (4, 2)), rng.uniform(0.4, 1.6), reacts=reacts)
        times = np.linspace(0.0, walker.duration, 100).tolist()
        if min(math.hypot(*walker.position(time)) for time in times) > 1.0:
            walkers.append(walker)
    return walkers


def _measure_wire() -> list[Figure]:
    """Measure codec and odometry, with wheel speeds that change in every line."""
    speeds = [tuple(row) for row in np.random.default_rng(0).uniform(-9, 9, (2000, 4)).tolist()]
    decoder, odometry = Decoder(), Odometry(0.05, 0.3)
    measured: list[tuple[str, Callable[[Any], object], list[Any]]] = [
        ("encode one line", encode, speeds),
        ("decode one line", decoder.feed, [encode(row) for row in speeds]),
        ("odometry update", lambda row: odometry.update(row, 0.01), speeds),
    ]

    def over(call: Callable[[Any], object], items: list[Any]) -> None:
        for item in items:
            call(item)

    return [
        Figure(name, median_duration(partial(over, call, items), 1) / len(items) * 1e6, "us")
        for name, call, items in measured
    ]


def _measure_recording() -> list[Figure]:
    """Compare ticks of the planar robot with a LiDAR at 100 Hz, with and without recording.

    Time of the thread's processor, in blocks that take turns, so that other threads and programs
    don't count: what a tick costs the control loop's own thread.
    """
    config = RobotConfig.of(None).with_(lidar={"rays": 360, "rate": 100.0})  # a scan in every tick

    def measure_tick(robot: Robot) -> float:
        begin = time.thread_time()
        for _ in range(RECORDING_TICKS):
            robot.drive(0.3, 0.2)
        took = (time.thread_time() - begin) / RECORDING_TICKS
        time.sleep(RECORDING_BREAK)
        return took

    with tempfile.TemporaryDirectory() as folder:
        bare, recorded = (
            Robot(open_link("planar", config), config, ["lidar"], recorder)
            for recorder in (None, Recorder(Path(folder) / "bench.mcap"))
        )
        with bare, recorded:
            pairs = [(measure_tick(bare), measure_tick(recorded)) for _ in range(ENV_BLOCKS)]
    without, with_it = (min(times) for times in zip(*pairs, strict=True))
    cost = max(with_it - without, 1e-9)
    return [Figure("recording, per tick, on the loop's thread", cost * 1e6, "us")]


def _measure_policies() -> list[Figure]:
    """Measure one decision of packaged policies."""
    figures = []
    for name, title in (("point_goal", ""), ("obstacle_goal", " with a map")):
        actor = OnnxPolicy(name)
        observation = np.zeros(actor.width, np.float32)
        took = median_duration(partial(actor, observation), 1000)
        figures.append(Figure(f"ONNX policy{title}, one decision", took * 1e6, "us"))
    return [*figures, Figure("map, one update", _measure_map(actor) * 1e6, "us")]


def _measure_map(policy: OnnxPolicy) -> float:
    """Return how long an update of the map takes [s]: the mean over a drive among obstacles."""
    env = make_simulated("ObstacleGoal-v1", "planar", worlds="clutter:1-20")
    inner: Any = env.unwrapped
    spent = []
    sensor = find_map(inner.robot.sensors)
    assert sensor is not None
    nowhere = np.full((1, 3), np.nan)
    robots = SensorInput(nowhere, nowhere, nowhere, np.zeros(1), scenes=(), rngs=(), memory=None)
    out = np.zeros((1, sensor.size))
    observation, _ = env.reset(seed=0)
    for _ in range(MAP_STEPS):
        observation, _, terminated, truncated, _ = env.step(policy(observation))
        begin = time.perf_counter()
        sensor.read(robots, out)
        spent.append(time.perf_counter() - begin)
        if terminated or truncated:
            observation, _ = env.reset()
    env.close()
    return float(np.mean(spent))


if __name__ == "__main__":
    Console().print(figure_table(measure_all()))
