"""Makes the bundle of a policy from the environment that it was trained in."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from acsar_gym.config import RobotConfig
from acsar_gym.config.fingerprint import calibration_sha256, config_sha256
from acsar_gym.config.footprint import radius
from acsar_gym.dynamics import Randomization
from acsar_gym.dynamics.model import turn_factor
from acsar_gym.envs.base import RobotEnv
from acsar_gym.envs.ids import full_id, without_module
from acsar_gym.errors import AcsarError, PolicyError
from acsar_gym.policies.bundle import (
    Action,
    Bundle,
    Env,
    Normalizer,
    Observation,
    Rates,
    Robot,
    SensorLayout,
    StateLayout,
    Training,
    Value,
)
from acsar_gym.recording.header import plain
from acsar_gym.sensors import LIDAR, Sensor
from acsar_gym.tasks import Task
from acsar_gym.vector.env import RobotVectorEnv

AnyEnv = RobotEnv | RobotVectorEnv
_LIMITS = ("max_acceleration", "min_acceleration", "max_deceleration", "max_velocity", "max_jerk")


def _field(name: str) -> Callable[[RobotConfig], Any]:
    """Return a function that reads a dotted field of a robot."""

    def read(config: RobotConfig) -> Any:
        value: Any = config
        for part in name.split("."):
            value = getattr(value, part)
        return value

    return read


def _fields(*names: str) -> dict[str, Callable[[RobotConfig], Any]]:
    return {name: _field(name) for name in names}


FIELDS: Mapping[str, Callable[[RobotConfig], Any]] = {
    **_fields("max_linear", "max_angular", "max_wheel_speed"),
    **_fields(*(f"{axis}_limits.{name}" for axis in ("linear", "angular") for name in _LIMITS)),
    **_fields("wheel_radius", "wheel_separation", "wheelbase", "wheel_separation_multiplier"),
    "turn_factor": turn_factor,
    **_fields("body.mass", "body.friction"),
    **_fields("motor.gain", "motor.time_constant", "motor.deadband", "motor.max_speed"),
    **_fields("firmware.command_delay"),
    "feedback_rate": lambda c: c.feedback_rate,
    "footprint.radius": lambda c: radius(c.outline),
}
"""What a bundle says of every robot: names, and how they are read from its config."""
LIDAR_FIELDS: Mapping[str, Callable[[RobotConfig], Any]] = {
    **_fields("lidar.rays", "lidar.field_of_view", "lidar.min_range", "lidar.max_range"),
    **_fields("lidar.rate", "lidar_x_offset", "lidar_y_offset"),
}
"""What it also says where the policy observes a LiDAR."""


def described(
    env: AnyEnv,
    env_id: str,
    *,
    randomization: Randomization | None = None,
    training: Training | None = None,
    metrics: Mapping[str, Mapping[str, float | None]] | None = None,
    state: Sequence[StateLayout] = (),
) -> Bundle:
    """Describe a policy that was trained in an environment.

    Args:
        env: the environment, one robot or a batch, with the arguments of the training.
        env_id: its id, such as "acsar_gym/PointGoal-v0" or "point_goal".
        randomization: what the training randomized; None where that isn't known.
        training: how it was trained; None where that isn't known.
        metrics: figures of the policy by occasion; NaN becomes null.
        state: the states of a recurrent policy.

    Raises:
        PolicyError: something of it can't be written in a bundle.
    """
    config, rate = config_of(env), rate_of(env)
    seen = observation(env.task, env.sensors)
    try:
        return Bundle(
            env=_env(env, env_id),
            observation=seen,
            action=Action(),
            state=tuple(state),
            rates=Rates(policy=rate, control=config.control_rate),
            robot=robot(config, env.sensors),
            randomization=None if randomization is None else ranges(randomization),
            training=training,
            metrics={name: _finite(figures) for name, figures in (metrics or {}).items()},
        )
    except AcsarError as error:
        raise PolicyError(f"the policy can't be described: {error}") from None


def config_of(env: AnyEnv) -> RobotConfig:
    """Return the config of an env's robot."""
    return env.robot.config if isinstance(env, RobotEnv) else env.config


def rate_of(env: AnyEnv) -> float:
    """Return the policy steps per second of an env [Hz]."""
    return config_of(env).control_rate / env.ticks_per_step


def observation(
    task: Task, sensors: Iterable[Sensor], normalizer: Normalizer | None = None
) -> Observation:
    """Describe the observation of a task and its sensors."""
    ends = [(_bound(low), _bound(high)) for low, high in task.observation.values()]
    return Observation(
        names=tuple(task.observation),
        low=tuple(low for low, _ in ends),
        high=tuple(high for _, high in ends),
        sensors=tuple(_sensor(sensor) for sensor in sensors),
        scale=scale_of(task),
        normalizer=normalizer,
    )


def scale_of(task: Task) -> float | None:
    """Return the length that a task divides observed distances by [m]; None if it has none."""
    scale: float | None = getattr(task, "scale", getattr(task, "max_cross_track", None))
    return None if scale is None else float(scale)


def robot(config: RobotConfig, sensors: Iterable[Sensor]) -> Robot:
    """Describe a robot: its hashes, and the values that decide how it answers a policy."""
    return Robot(
        name=config.name,
        sha256=config_sha256(config),
        calibration_sha256=calibration_sha256(config),
        values=values(config, sensors),
    )


def values(config: RobotConfig, sensors: Iterable[Sensor]) -> dict[str, Value]:
    """Return a robot's values by name: those of FIELDS, and with a LiDAR of LIDAR_FIELDS."""
    sees = any(sensor.name == LIDAR for sensor in sensors)
    readers = {**FIELDS, **(LIDAR_FIELDS if sees else {})}
    return {name: read(config) for name, read in readers.items()}


def ranges(randomization: Randomization) -> dict[str, tuple[float, ...]]:
    """Return the ranges of a randomization by name."""
    return {name: tuple(getattr(randomization, name)) for name in randomization.names}


def _env(env: AnyEnv, env_id: str) -> Env:
    """Describe the task and the worlds of an env."""
    spec, task = env.spec, env.task
    fields: Any = dataclasses.fields(task) if dataclasses.is_dataclass(task) else ()
    return Env(
        id=without_module(full_id(env_id)),
        options={one.name: plain(getattr(task, one.name)) for one in fields},
        worlds="" if env.pool is None else str(env.pool),
        max_episode_steps=None if spec is None else spec.max_episode_steps,
    )


def _sensor(sensor: Sensor) -> SensorLayout:
    low, high = sensor.bounds
    return SensorLayout(
        name=sensor.name,
        size=sensor.size,
        low=_bound(low.min()),
        high=_bound(high.max()),
        layout=sensor.layout,
    )


def _bound(value: float) -> float | None:
    """Return one end of a range; None for infinity."""
    return float(value) if math.isfinite(value) else None


def _finite(figures: Mapping[str, float | None]) -> dict[str, float | None]:
    """Return figures with null for NaN and infinity."""
    return {
        name: None if value is None or not math.isfinite(value) else float(value)
        for name, value in figures.items()
    }
