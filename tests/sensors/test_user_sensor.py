"""A user's range finder in one env after the other: simulated twice, and on a real terminal."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from range_finder import REACH, ThreeRays, three_rays
from serial_tools import Emulated, no_leak

from acsar_gym import RobotConfig, Sensor, World
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import AcsarError, LinkError
from acsar_gym.links.base import Link
from acsar_gym.sensors.map.sensor import MAP_NAMES
from acsar_gym.tasks import ObstacleGoal, PointGoal
from acsar_gym.worlds import Region

WALL = World(
    segments=np.array([[2.0, -9.0, 2.0, 9.0]]),
    start=Region(0.5, 0.0, 0.0, 0.0),
    goal=Region(1.5, 0.0),
)
FORWARD = np.array([0.4, 0.0], np.float32)
START = 0.09
"""Time by which a simulated robot has been reset, and its first step isn't over [s]."""
Make = Callable[..., RobotEnv]


@pytest.fixture
def make() -> Iterator[Make]:
    """`make(link, *sensors, sees=False, ...)` is an env before a wall, closed with the test."""
    with contextlib.ExitStack() as stack:

        def begin(link: str, *sensors: Any, sees: bool = False, **options: Any) -> RobotEnv:
            if sees:
                options["worlds"] = WALL
            task = ObstacleGoal if sees else PointGoal
            env = RobotEnv(task, link, sensors=sensors, **options)
            return stack.enter_context(contextlib.closing(env))

        yield begin


class Quiet(ThreeRays):
    noise = 0.0


@pytest.mark.parametrize("link", ["planar", "bullet"])
def test_sensor_sees_the_wall_in_both_simulations(make: Make, link: str) -> None:
    env = make(link, Quiet, sees=True, robot={"lidar": {"noise": 0.0, "rays": 4}})
    side = 1.5 / math.cos(math.radians(30.0))
    observation, info = env.reset(seed=0)
    assert observation.shape == (7 + len(MAP_NAMES) + 4 + 3,)
    assert observation[-3:] == pytest.approx(np.array([side, 1.5, side]) / REACH, abs=0.01)
    assert info["three_rays_time"] == env.robot.link.now()
    for _ in range(10):
        observation, *_, info = env.step(FORWARD)
    assert observation[-2] * REACH == pytest.approx(1.5 - info["odom_x"], abs=0.02)
    assert [sensor.name for sensor in env.robot.sensors] == ["map", "lidar", "three_rays"]
    assert "scan_age" in info


def test_spec_with_a_sensor_is_plain_and_makes_an_equal_env() -> None:
    """Noise repeats with the seed."""
    env: Any = gymnasium.make("acsar_gym/PointGoal-v0", link="planar", sensors=[three_rays])
    assert '"range_finder:three_rays"' in env.spec.to_json()
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    first = again.reset(seed=1)[0]
    for seed in (1, 2):
        assert (first == env.reset(seed=seed)[0]).all() == (seed == 1)
    env.close()
    again.close()


class NearBumper(Sensor):
    """Uses the LiDAR and odometry."""

    name = "near_bumper"
    size = 2
    needs = ("lidar",)

    def read(self, robots: Any, out: Any) -> None:
        lidar: Any = self.needed["lidar"]
        out[0] = (lidar.scan.ranges.min(), self.odometry.pose[0])


def test_sensor_can_use_the_lidar_and_odometry(make: Make) -> None:
    env = make("planar", NearBumper, sees=True)
    env.reset(seed=0)
    observation, *_, info = env.step(FORWARD)
    nearest = observation[-66:-2].min() * env.robot.config.lidar.max_range
    assert observation[-2:] == pytest.approx([nearest, info["odom_x"]], rel=1e-6)
    with pytest.raises(AcsarError, match="the robot has no 'lidar', which it needs"):
        make("planar", NearBumper)


class Thermometer(Sensor):
    """Measures on the real robot, with a clock of its own."""

    name = "thermometer"
    size = 2
    high = 100.0

    def __init__(self, link: Link, config: RobotConfig) -> None:
        super().__init__(link, config)
        self.polls = 0
        self.closed = 0

    def poll(self, truth: Any, now: float) -> None:
        assert truth is None
        self.polls += 1

    def read(self, robots: Any, out: Any) -> None:
        assert np.isnan(robots.pose).all()
        out[0] = (20, min(self.polls, 100))

    def close(self) -> None:
        self.closed += 1


def by_link(link: Link, config: RobotConfig) -> Sensor:
    """A factory that chooses."""
    return Thermometer(link, config) if link.truth is None else ThreeRays(link, config)


@pytest.mark.usefixtures("deadline")
def test_sensor_of_a_real_robot_may_be_another(
    make: Make, emulator: Emulated, config: RobotConfig
) -> None:
    with no_leak():
        env = make(emulator.device, by_link, robot=config)
        first, _ = env.reset(seed=0)
        assert first[-2:].tolist() == [20.0, 1.0]
        observation, *_ = env.step(FORWARD * 0.25)
        assert observation[-2:].tolist() == [20.0, 1.0 + env.ticks_per_step]
        sensor: Any = env.robot.sensors[0]
        env.reset()
        assert sensor.closed == 0
        env.close()
        assert sensor.closed == 1
    assert make("planar", by_link).robot.sensors[0].name == "three_rays"


def broken(error: Exception | None) -> type[Sensor]:
    """A sensor that raises an error in the first step, or fills nothing in."""

    class Broken(ThreeRays):
        def read(self, robots: Any, out: Any) -> None:
            if robots.now[0] < START:
                super().read(robots, out)
            elif error is not None:
                raise error

    return Broken


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (None, r"\[nan, nan, nan\]: must fill out"),
        (ValueError("too hot"), r"ValueError: too hot \(.*/test_user_sensor.py:\d+\)"),
    ],
)
def test_sensor_with_wrong_numbers_stops_the_robot(
    make: Make, error: Exception | None, message: str
) -> None:
    env = make("planar", broken(error))
    env.reset(seed=0)
    with pytest.raises(AcsarError, match=f"'three_rays'.*{message}") as caught:
        env.step(FORWARD)
    assert "\n" not in str(caught.value)
    assert not env.robot.active


def test_sensor_that_falls_silent_ends_the_episode(make: Make) -> None:
    env = make("planar", broken(LinkError("the sonar is silent", "check its cable")))
    env.reset(seed=0)
    *_, truncated, info = env.step(FORWARD)
    assert truncated
    assert info["fault_reason"] == "the sonar is silent: check its cable"
    assert not env.robot.active
