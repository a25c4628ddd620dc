"""Sensors of users in a batch: the same numbers as in the single planar env."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from range_finder import ThreeRays

from acsar_gym.envs import ids
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.sensors import Sensor, draw_normal, draw_uniform
from acsar_gym.tasks import PointGoal

ENV_ID = "acsar_gym/ObstacleGoal-v1"


class Gyro(Sensor):
    """Yaw rate with a bias that walks, and drop-outs, in which it holds its last value [rad/s]."""

    name = "gyro"
    size = 2
    low = -10.0
    high = 10.0
    memory: ClassVar[Mapping[str, float]] = {"bias": 0.5, "time": 0.0, "held": 0.0}
    compiled = True
    walk = 0.02
    """[rad/s per root of a second]"""

    def reset(self, robots: Any) -> None:
        for i in range(len(robots.now)):
            robots.memory.bias[i] += 0.1 * draw_normal(robots.rngs, i)

    def read(self, robots: Any, out: Any) -> None:
        memory = robots.memory
        rngs = robots.rngs
        for i in range(len(out)):
            duration = max(robots.now[i] - memory.time[i], 0.0)
            memory.bias[i] += self.walk * math.sqrt(duration) * draw_normal(rngs, i)
            memory.time[i] = robots.now[i]
            if draw_uniform(rngs, i) > 0.3:
                noise = 0.01 * draw_normal(rngs, i)
                memory.held[i] = robots.twist[i, 1] + memory.bias[i] + noise
            out[i, 0] = memory.held[i]
            out[i, 1] = math.cos(robots.pose[i, 2])


class PlainGyro(Gyro):
    """Isn't compiled."""

    name = "plain_gyro"
    compiled = False


class Drifted(Sensor):
    """Remembers, and sees the scene."""

    name = "drifted"
    size = 2
    memory: ClassVar[Mapping[str, float]] = {"x": 0.0, "readings": 0.0}

    def reset(self, robots: Any) -> None:
        for i, scene in enumerate(robots.scenes):
            robots.memory.x[i] = scene.start[0] + robots.rngs[i].normal()

    def info(self, robots: Any) -> dict[str, Any]:
        return {"readings": robots.memory.readings}

    def read(self, robots: Any, out: Any) -> None:
        robots.memory.readings[:] += 1.0
        out[:] = np.column_stack([robots.pose[:, 0] - robots.memory.x, robots.memory.readings])


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("kind", ["ObstacleGoal", "PointGoal"])
def test_batch_sensors_read_what_single_ones_do(
    kind: str, mode: AutoresetMode, compare: Any
) -> None:
    options: dict[str, Any] = {
        "sensors": [PlainGyro, Drifted, ThreeRays, Gyro],
        "max_episode_steps": 5,
    }
    options |= {} if kind == "PointGoal" else {"worlds": "clutter:6"}
    assert compare(kind, options, 20, range(4), 4, mode=mode) >= 8


def make_batch(*sensors: Any, robots: int = 2, **options: Any) -> Any:
    return ids.make_vec(
        ENV_ID, robots, sensors=sensors, **{"worlds": "clutter:3", "threads": 1, **options}
    )


def failing(numbers: Any) -> Any:
    """Fails at the third reading, for robot 2."""

    class Failing(ThreeRays):
        readings = 0

        def read(self, robots: Any, out: Any) -> None:
            super().read(robots, out)
            self.readings += 1
            if self.readings == 3:
                if isinstance(numbers, Exception):
                    raise numbers
                out[2] = numbers

    return Failing


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        (np.array([0.0, np.nan, 0.0]), "nan.* for robot 2"),
        (ValueError("too hot"), r"too hot \(.*test_sensors.py:\d+"),
    ],
)
def test_sensor_errors_need_a_reset(numbers: Any, message: str) -> None:
    env = make_batch(failing(numbers), robots=4)
    first, _ = env.reset(seed=0)
    env.step(np.zeros((4, 2)))
    with pytest.raises(AcsarError, match=f"^sensor 'three_rays'.*{message}"):
        env.step(np.zeros((4, 2)))
    with pytest.raises(ConfigError, match="interrupted"):
        env.step(np.zeros((4, 2)))
    assert (env.reset(seed=0)[0] == first).all()
    env.step(np.zeros((4, 2)))


def test_draws_of_a_sensor_are_those_of_its_generator() -> None:
    rngs = [np.random.default_rng(seed) for seed in range(2)]
    uniform = np.random.default_rng(1).random(3)
    assert draw_uniform(rngs, 1) == uniform[0]
    radius = math.sqrt(-2.0 * math.log(1.0 - uniform[1]))
    assert draw_normal(rngs, 1) == radius * math.cos(2.0 * math.pi * uniform[2])


class Shouting(Drifted):
    """Has the key of another sensor."""

    name = "shouting"


class Colliding(Drifted):
    """Has a key of the env."""

    def info(self, robots: Any) -> dict[str, Any]:
        return {"true_x": robots.now}


@pytest.mark.parametrize("sensors", [(Drifted, Shouting), (Colliding,)])
def test_info_of_a_sensor_has_its_own_keys(sensors: tuple[Any, ...]) -> None:
    for env in (make_batch(*sensors), RobotEnv(PointGoal, "planar", sensors=sensors)):
        with pytest.raises(ConfigError, match=r"info has '(readings|true_x)' already"):
            env.reset(seed=0)
        env.close()


class Miscounting(Drifted):
    """Its info is of more robots than there are."""

    def info(self, robots: Any) -> dict[str, Any]:
        return {"readings": np.zeros(len(robots.now) + 1)}


class Speechless(Drifted):
    """Its info returns nothing."""

    def info(self, robots: Any) -> Any:
        """Do nothing."""


@pytest.mark.parametrize(
    ("sensor", "message"), [(Miscounting, "ValueError: shape mismatch"), (Speechless, "NoneType")]
)
def test_info_of_a_wrong_kind_names_the_sensor(sensor: type[Sensor], message: str) -> None:
    with pytest.raises(AcsarError, match=f"^sensor 'drifted': .*{message}"):
        make_batch(sensor).reset(seed=0)


class Misnames(Gyro):
    compiled = True

    def reset(self, robots: Any) -> None:
        robots.memory.bais[0] = 1.0


class Polled(ThreeRays):
    def poll(self, truth: Any, now: float) -> None:
        """Isn't called in a batch."""


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        (Misnames, r"sensor 'gyro': numba can't compile .*reset\(\)\n(.|\n)*bais"),
        (Polled, "'three_rays': has poll or needs, which .* vectorization_mode='async'"),
        ("lidar", "two are named 'lidar'"),
    ],
)
def test_sensor_that_cannot_be_in_a_batch_is_named(sensor: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_batch(sensor).reset(seed=0)
