"""Sensors of a user's own in a batch: the same numbers as in the single planar env."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
from range_finder import BEARINGS, REACH, ThreeRays

from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.lidar.simulated import SimulatedLidar
from acsar_gym.sensors import Sensor, draw_normal, draw_uniform
from acsar_gym.sensors.lidar import LidarSensor
from acsar_gym.worlds.geometry import measure_ranges

ENV_ID = "acsar_gym/ObstacleGoal-v1"


class Drifting(ThreeRays):
    """Has a bias of its own in every episode, and a clock: it measures every third tick."""

    name = "drifting"

    def reset(self, scene: Any, rng: Any) -> None:
        super().reset(scene, rng)
        self.bias = rng.normal(0.0, 0.1)
        self.due = 0.0
        self.numbers = np.zeros(3)

    def poll(self, truth: Any, now: float) -> None:
        if now >= self.due - 1e-9:
            self.due = now + 0.03
            self.numbers = np.clip(super().read(truth, now) + self.bias, 0.0, 1.0)

    def read(self, truth: Any, now: float) -> Any:
        return self.numbers

    def info(self, now: float) -> dict[str, float]:
        return {"bias": self.bias}


class Coin(ThreeRays):
    """Draws half a number of 64 bits at a time."""

    name, size = "coin", 1

    def read(self, truth: Any, now: float) -> Any:
        return self.rng.integers(2, size=1, dtype=np.int32)

    def info(self, now: float) -> dict[str, float]:
        return {}


class AtOnce(Sensor):
    """The range finder for a whole batch, and for one robot by the same function."""

    name, size, low, high = "at_once", 3, 0.0, 1.0

    def read(self, truth: Any, now: float) -> Any:
        out = np.zeros((1, 3))
        self.read_batch(
            (np.array([truth.pose]), None, None), [self.scene], np.array([now]), [self.rng], out
        )
        return out[0]

    def read_batch(self, truths: Any, scenes: Any, now: Any, rngs: Any, out: Any) -> None:
        for row, pose, scene, rng in zip(out, truths[0].tolist(), scenes, rngs, strict=True):
            ranges = measure_ranges((pose[0], pose[1]), pose[2] + BEARINGS, scene.world)
            row[:] = np.clip(ranges + rng.normal(0.0, 0.01, 3), 0.0, REACH) / REACH


class Gyro(Sensor):
    """Yaw rate with a bias that walks, and drop-outs, in which it holds its last value [krad/s].

    The unit makes numbers so small that float32 keeps them to 1e-9.
    """

    name, size, low, high = "gyro", 2, -10.0, 10.0
    memory: ClassVar[Mapping[str, float]] = {"bias": 0.5, "time": 0.0, "held": 0.0}
    compiled = True
    walk = 0.02
    """[rad/s per root of a second]"""

    def reset_batch(self, scenes: Any, rngs: Any, memory: Any) -> None:
        for i in range(len(rngs)):
            memory.bias[i] += 0.1 * draw_normal(rngs, i)

    def read_batch(
        self, truths: Any, scenes: Any, now: Any, rngs: Any, out: Any, memory: Any
    ) -> None:
        for i in range(len(out)):
            memory.bias[i] += (
                self.walk * math.sqrt(max(now[i] - memory.time[i], 0.0)) * draw_normal(rngs, i)
            )
            memory.time[i] = now[i]
            if draw_uniform(rngs, i) > 0.3:
                memory.held[i] = truths.twist[i, 1] + memory.bias[i] + 0.01 * draw_normal(rngs, i)
            out[i, 0], out[i, 1] = 0.001 * memory.held[i], 0.001 * math.cos(truths.pose[i, 2])


class PlainGyro(Gyro):
    """As it is, but not compiled."""

    name, compiled = "plain_gyro", False


class Drifted(Sensor):
    """Remembers, sees the scene, and isn't compiled."""

    name, size = "drifted", 2
    memory: ClassVar[Mapping[str, float]] = {"x": 0.0, "readings": 0.0}

    def reset_batch(self, scenes: Any, rngs: Any, memory: Any) -> None:
        memory.x[:] = [
            scene.start[0] + rng.normal() for scene, rng in zip(scenes, rngs, strict=True)
        ]

    def read_batch(
        self, truths: Any, scenes: Any, now: Any, rngs: Any, out: Any, memory: Any
    ) -> None:
        memory.readings[:] += 1.0
        out[:] = np.column_stack([truths.pose[:, 0] - memory.x, memory.readings])


CASES: dict[str, tuple[str, tuple[Any, ...], dict[str, Any]]] = {
    "with a clock": (ENV_ID, (Drifting,), {"worlds": "clutter:6"}),
    "several": (ENV_ID, (Coin, ThreeRays, Drifting), {"worlds": "clutter:6"}),
    "no LiDAR": ("acsar_gym/PointGoal-v0", (ThreeRays, Coin), {}),
    "that remembers, compiled": (ENV_ID, (Coin, ThreeRays, Gyro), {"worlds": "clutter:6"}),
    "that remembers": (
        "acsar_gym/PointGoal-v0",
        (PlainGyro, Drifted, Coin, Gyro),
        {"max_episode_steps": 5},
    ),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_robots_of_a_batch_sense_what_single_ones_do(name: str, mode: str) -> None:
    env_id, sensors, options = CASES[name]
    options = {"sensors": sensors, "max_episode_steps": 9, **options}
    many: Any = gymnasium.make_vec(
        env_id, 4, vectorization_mode="vector_entry_point", autoreset_mode=mode, **options
    )
    ones = [gymnasium.make(env_id, link="planar", **options) for _ in range(4)]
    same_step, rng = mode == "SameStep", np.random.default_rng(0)
    assert many.single_observation_space == ones[0].observation_space
    seen, infos = many.reset(seed=5)
    expected = [one.reset(seed=5 + i) for i, one in enumerate(ones)]
    ended = [False] * 4
    for _ in range(30):
        for i, (observation, info) in enumerate(expected):
            assert seen[i] == pytest.approx(observation, abs=1e-6)
            if sensors[-1] is Gyro:
                assert seen[i, -2:] == pytest.approx(observation[-2:], rel=0.0, abs=1e-9)
            got = {key: infos[key][i] for key in info}
            assert got == pytest.approx(info, abs=1e-9)
            assert all(infos[f"_{key}"][i] for key in info)
        actions = rng.uniform(-1.0, 1.0, (4, 2))
        seen, _, _, _, infos = many.step(actions)
        for i, one in enumerate(ones):
            if ended[i] and not same_step:
                expected[i], ended[i] = one.reset(), False
                continue
            observation, _, *ends, info = one.step(actions[i])
            expected[i], ended[i] = (observation, info), any(ends)
            if any(ends) and same_step:
                assert infos["final_obs"][i] == pytest.approx(observation, abs=1e-6)
                expected[i] = one.reset()
    many.close()
    for one in ones:
        one.close()


def batch(*sensors: Any, robots: int = 64, **options: Any) -> Any:
    return gymnasium.make_vec(
        ENV_ID,
        robots,
        vectorization_mode="vector_entry_point",
        sensors=sensors,
        **{"worlds": "clutter:3", "threads": 1, **options},
    )


def failing(what: Any, robot: int) -> Any:
    """Fails at the third reading of one robot."""

    class Failing(ThreeRays):
        made = 0

        def __init__(self, link: Any, config: Any) -> None:
            super().__init__(link, config)
            self.fails, self.read_times = type(self).made == robot, 0
            type(self).made += 1

        def read(self, truth: Any, now: float) -> Any:
            self.read_times += 1
            if self.fails and self.read_times == 3:
                if isinstance(what, Exception):
                    raise what
                return what
            return super().read(truth, now)

    return Failing


@pytest.mark.parametrize(
    ("what", "message"),
    [
        (np.zeros(2), "shape"),
        (np.array([0.0, np.nan, 0.0]), "nan"),
        (ValueError("too hot"), r"too hot \(.*test_sensors.py:\d+"),
    ],
)
def test_errors_name_the_robot_and_need_a_reset(what: Any, message: str) -> None:
    env = batch(failing(what, 2), robots=4)
    first, _ = env.reset(seed=0)
    env.step(np.zeros((4, 2)))
    with pytest.raises(AcsarError, match=f"'three_rays'.*{message}") as caught:
        env.step(np.zeros((4, 2)))
    notes = getattr(caught.value, "__notes__", [])
    assert "sensor 'three_rays' of robot 2" in [*notes, str(caught.value).partition(":")[0]]
    with pytest.raises(ConfigError, match="interrupted"):
        env.step(np.zeros((4, 2)))
    assert (env.reset(seed=0)[0] == first).all()
    env.step(np.zeros((4, 2)))
    env.close()


def test_numbers_of_a_compiled_sensor_are_those_of_its_generator() -> None:
    rngs = [np.random.default_rng(seed) for seed in range(2)]
    same = np.random.default_rng(1).random(3)
    assert draw_uniform(rngs, 1) == same[0]
    radius = math.sqrt(-2.0 * math.log(1.0 - same[1]))
    assert draw_normal(rngs, 1) == radius * math.cos(2.0 * math.pi * same[2])
    drawn = np.array([draw_normal(rngs, 0) for _ in range(20_000)])
    assert [drawn.mean(), drawn.std(), (drawn**4).mean()] == pytest.approx([0, 1, 3], abs=0.15)


class Wrong(Gyro):
    """A compiled sensor does what it may not."""

    name, compiled = "wrong", True

    def read_batch(
        self, truths: Any, scenes: Any, now: Any, rngs: Any, out: Any, memory: Any
    ) -> None:
        out[:] = 0.0


class UsesScenes(Wrong):
    compiled = True

    def read_batch(
        self, truths: Any, scenes: Any, now: Any, rngs: Any, out: Any, memory: Any
    ) -> None:
        out[0, 0] = scenes[0].start[0]


class Misnames(Wrong):
    compiled = True

    def reset_batch(self, scenes: Any, rngs: Any, memory: Any) -> None:
        memory.bais[0] = 1.0


class UsesGenerators(Wrong):
    compiled = True

    def reset_batch(self, scenes: Any, rngs: Any, memory: Any) -> None:
        memory.bias[0] = rngs[0].normal()


@pytest.mark.parametrize(
    ("kind", "error", "said"),
    [
        (UsesScenes, ConfigError, "can't compile it: .*a compiled sensor has no scenes"),
        (Misnames, ConfigError, "can't compile it: .*bais"),
        (UsesGenerators, ConfigError, "can't compile it: .*draws by draw_uniform or draw_normal"),
    ],
)
def test_what_a_compiled_sensor_may_not_do_is_named(kind: Any, error: Any, said: str) -> None:
    env = batch(kind, robots=2)
    with pytest.raises(error, match=f"^sensor 'wrong': .*{said}") as caught:
        env.reset(seed=0)
    assert "\n" not in str(caught.value)
    env.close()


class Polled(AtOnce):
    def poll(self, truth: Any, now: float) -> None:
        """Isn't called in a batch."""


def own_lidar(link: Any, config: Any) -> Sensor:
    return LidarSensor(SimulatedLidar(link, config), config)


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        ((ThreeRays(None, None),), "needs one for each robot: pass its class"),  # type: ignore[arg-type]
        ((Polled,), "reset, poll and info aren't used in a batch: .*reset_batch"),
        ((own_lidar,), "sensor 'lidar': a batch has no LiDAR but its own: name it 'lidar'"),
        (("lidar",), "sensors: two are named 'lidar'"),
    ],
)
def test_what_cannot_be_in_a_batch_is_named(sensors: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        batch(*sensors, robots=2).reset(seed=0)
    assert "\n" not in str(caught.value)
