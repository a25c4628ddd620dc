"""Measure the speed of envs, batches, rays, codec, recordings and policies: `make bench`.

The speed of a machine drifts. So things that are compared run in alternating blocks, figures are
medians over the blocks, and ratios are medians of the ratios of neighbouring blocks.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
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
from acsar_gym.envs import ids
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.links import open_link
from acsar_gym.protocol import Decoder, encode
from acsar_gym.recording import Recorder
from acsar_gym.robot import Robot
from acsar_gym.sensors import SensorInput
from acsar_gym.sensors.map.sensor import find_map
from acsar_gym.tools.policies import OnnxPolicy
from acsar_gym.vector.threads import usable_cores
from acsar_gym.worlds import World
from acsar_gym.worlds.geometry import cast_lines, make_surroundings

BLOCKS = 25
ENV_STEPS = 100
"""Env steps in one block."""
ROBOTS = 1024
"""Robots of a batch."""
ACSAR = RobotConfig.of(None)

Figure = tuple[str, float, str]
"""What is measured, the number and its unit."""
Measurement = Callable[[], float]
"""Runs one block, and returns seconds."""


def mean_duration(
    call: Callable[[], object], times: int, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Return the mean duration of `times` calls [s]."""
    start = clock()
    for _ in range(times):
        call()
    return (clock() - start) / times


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
    bearing, turn = np.exp(1.0j * rng.uniform(-np.pi, np.pi, (2, count)))
    centre = rng.uniform(1.5, 6.0, count) * bearing
    end = centre + 0.5 * turn
    columns = (centre.real, centre.imag, rng.uniform(0.1, 0.3, count))
    walls = np.column_stack([centre.real, centre.imag, end.real, end.imag])
    return World(np.column_stack(columns)[:circles], walls[circles:])


class Driver:
    """An env that is driven with random actions."""

    def __init__(self, env_id: str, link: str, **options: Any) -> None:
        self.env = gymnasium.make(f"acsar_gym/{env_id}", link=link, **options)
        self.inner: Any = self.env.unwrapped
        self.env.reset(seed=0)
        rng = np.random.default_rng(0)
        self._actions = rng.uniform(-1.0, 1.0, (ENV_STEPS, 2)).astype(np.float32)

    def __call__(self) -> float:
        """Drive a block, resets included, and return the duration of a step [s]."""
        start = time.perf_counter()
        for action in self._actions:
            _, _, terminated, truncated, _ = self.env.step(action)
            if terminated or truncated:
                self.env.reset()
        return (time.perf_counter() - start) / ENV_STEPS


def measure_envs() -> Iterator[Figure]:
    """Measure single envs, serial protocol included, without obstacles and with them."""
    obstacles = {"worlds": crowded_world(50, 10)}
    for name, driver in (
        ("PyBullet", Driver("PointGoal-v0", "bullet")),
        ("planar", Driver("PointGoal-v0", "planar")),
        ("PyBullet, 64 rays, 60 obstacles", Driver("ObstacleGoal-v1", "bullet", **obstacles)),
    ):
        tick = median(driver() for _ in range(BLOCKS)) / driver.inner.ticks_per_step
        yield f"{name}: env, wire included, per tick", tick * 1e6, "us"
        yield f"{name}: env speed", ACSAR.period / tick, "x real time"


def measure_rays() -> Iterator[Figure]:
    """Measure 64 rays among 100 obstacles."""
    around = make_surroundings(crowded_world(80, 20), ray_spec(ACSAR), ACSAR)
    origins = np.zeros((ACSAR.lidar.rays, 2))
    pose = (0.0, 0.0, 1.0, 0.0)
    cast = partial(cast_lines, *pose, 0, around, origins, np.empty(ACSAR.lidar.rays))
    yield "64 rays among 100 obstacles", median_duration(cast, 200) * 1e6, "us"


def step_batch(env_id: str, threads: int, **options: Any) -> Measurement:
    """Return a measurement of a step of a new batch with random actions."""
    env = ids.make_vec(f"acsar_gym/{env_id}", ROBOTS, threads=threads, **options)
    env.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (ROBOTS, 2)).astype(np.float32)
    return partial(mean_duration, partial(env.step, actions), 10)


def measure_batches() -> Iterator[Figure]:
    """Measure batches on one core and on all cores, and against the PyBullet env."""
    cores = usable_cores()
    worlds = [crowded_world(50, 10, seed) for seed in range(64)]
    kinds: dict[str, tuple[str, dict[str, Any]]] = {
        f"batch of {ROBOTS} planar robots": ("PointGoal-v0", {}),
        "batch with 64 rays and 60 obstacles": ("ObstacleGoal-v1", {"worlds": worlds}),
    }
    for name, (env_id, options) in kinds.items():
        one_core = step_batch(env_id, 1, **options)
        step, _, gain = alternate(one_core, step_batch(env_id, cores, **options))
        yield f"{name}, one core", ROBOTS / step, "steps/s"
        yield f"{name}, {cores} cores against one", gain, "x the steps"

    single, _, ratio = alternate(Driver("PointGoal-v0", "bullet"), step_batch("PointGoal-v0", 1))
    yield "PyBullet: env steps", 1.0 / single, "steps/s"
    yield "batch against the PyBullet env", ratio * ROBOTS, "x the steps"


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
    config = ACSAR.with_(lidar={"rays": 360, "rate": 100.0})

    def measure_tick(robot: Robot) -> float:
        spent = mean_duration(lambda: robot.drive(0.3, 0.2), ENV_STEPS, time.thread_time)
        time.sleep(0.05)  # the writer catches up
        return spent

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
    driver = Driver("ObstacleGoal-v1", "planar", worlds="clutter:1-20")
    sensor = find_map(driver.inner.robot.sensors)
    assert sensor is not None
    nowhere = np.full((1, 3), np.nan)
    robots = SensorInput(nowhere, nowhere, nowhere, np.zeros(1), scenes=(), rngs=(), memory=None)
    update = partial(sensor.read, robots, np.zeros((1, sensor.size)))
    updates = []
    observation, _ = driver.env.reset(seed=0)
    for _ in range(3 * ENV_STEPS):
        observation, _, terminated, truncated, _ = driver.env.step(policy(observation))
        updates.append(mean_duration(update, 1))
        if terminated or truncated:
            observation, _ = driver.env.reset()
    yield "map, one update", float(np.mean(updates)) * 1e6, "us"


MEASUREMENTS = (
    measure_envs,
    measure_rays,
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
